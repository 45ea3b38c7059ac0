# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether a calibration still holds, by a short recording of its target; if not, what has changed.

With nothing changed, the residuals r of the recording at the answer of the calibration are
r = E e + n: e are the errors of the calibration's transform and target, by their joint covariance,
and the systematic ones of robot, sensor and target, as large as the calibration found them; n is
the noise that the calibration found, at least that which is configured. A move m of target or
sensor adds D m; a changed robot adds an error of each pose, smooth over the poses or white. Each
has a normal prior, averaged over MOVE_SCALES, so each cause has a marginal likelihood. A change is
reported if the causes together are MIN_EVIDENCE times as likely as none: by Markov's inequality
the probability of a false alarm is at most 1 / MIN_EVIDENCE (Wald 1945). If the stops do not
distinguish several causes, the sentence names these and their probabilities; if nothing changed,
the smallest change that would have shown.
"""
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
import math
from typing import Any, Literal, NamedTuple

from handeye_ros import frames, pipeline, se3
from handeye_ros.arithmetic import evenly_spaced, rms
from handeye_ros.config import Config, NoiseConfig
from handeye_ros.data import (
    AnyProfile,
    Array,
    Calibration,
    ClockEstimate,
    Indices,
    Reject,
    ROBOT_POSITION_ERROR,
    Sample,
    TimedPose,
)
from handeye_ros.errors import DataError, InputError
from handeye_ros.estimation.blocks import (
    DISTORTION_ERROR,
    LINE_BEND,
    line_bend,
    sensor_distortion,
    wrt_smooth,
)
from handeye_ros.estimation.noise import NoiseModel, Whitening, whitening
from handeye_ros.estimation.problem import (
    Estimate,
    has_unused_edges,
    Linearisation,
    linearise,
    Problem,
    UNUSED,
)
from handeye_ros.estimation.target import Target
from handeye_ros.frames import direction_in_words, mount_frame, target_frame
from handeye_ros.targets import TARGETS
from handeye_ros.targets.profile_target import FLATNESS_ERROR, GRAZING
from handeye_ros.verification.group_fit import (
    covariance_root,
    fit_without_outliers,
    GroupFit,
    largest_displacement,
    ONE_SIDED_95,
    regularised_least_squares,
)
from handeye_ros.verification.station_set import require_stations, stop_number
from handeye_ros.words import mm
import numpy as np
from scipy.special import softmax

FORMAT = 'handeye_ros/check/2'
MIN_EVIDENCE = 100.0
SURE_CHANGE_SIGMAS = 4.0  # sigmas of a change of the time offset
MIN_CHANGE = 1e-4  # s: a smaller change does not matter to a scan
MOVE_SCALES = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)  # m: how far something moves, a priori
TYPICAL_SCALE = 1e-3  # m, one of these
MOVE_TURN_LENGTH = 0.1  # m: a scale over it is that of a turn
STEP_COUNT = 6  # of the search for the likeliest move
MAX_LOST_SHARE = 0.2  # of the stations: with edges far from those of the target
NAMED_FROM = 0.95  # probability with which one cause, or some together, are named
MAX_OF_SWEEP = 30  # samples of a sweep: neighbours share the errors of the robot
UNSEEN_SHIFT = 0.01  # m: a shift that would show only from here on is called unseen
NO_MOVE = np.zeros(6)
Part = Literal['target', 'sensor']
MOVABLE: tuple[Part, Part] = 'target', 'sensor'
CAUSES = *MOVABLE, 'robot'
ROBOT_CHANGED = ('the poses of the robot err otherwise than before (mastering, a joint, wear), '
                 'or repeat worse than noise.robot_* says: check the robot before the sensor')
MORE_STOPS = ('Repeat some of them with the sensor turned by 90 degrees about its z, and by 25 '
              'degrees about x and y: an error of the robot differs there, a move does not')


@dataclass(frozen=True)
class Move:
    """
    The likeliest move of target or sensor, and the smallest shifts that would have shown.

    moved, turned: shift and turn of the likeliest move (m, rad)
    shows: along each of three axes the smallest shift (m) that would have shown, nan
        where none below UNSEEN_SHIFT would
    axes: (3, 3) the directions of these axes as rows, of the target in the base, of the sensor in
        the flange; with eye_on_base it is the other way round
    """

    moved: float
    turned: float
    shows: list[float]
    axes: list[list[float]]


@dataclass(frozen=True)
class Check:
    """
    Result of a check.

    stamps: of all samples (ns); the file has the first
    verdict: unchanged, or the causes: target, sensor (it moved, or the robot's base did that is
        fixed to the other), robot (its pose errors changed), clock, with "or" or "and"
    sentence: the verdict for the user, with what to do
    stations: number of the compared stations
    rms: RMS of the residuals (m)
    evidence: how many times as likely the recording is with a change as without
    probabilities: of each cause if something changed
    target, sensor: their likeliest moves
    points_off: the largest error of points if the sensor is the cause, and its std (m)
    contradicting: numbers of the stops, of a sweep of the passes, with what contradicts the others
        and is not used
    time_offset_changed: change of the time offset of a sweep, and its 1 sigma (s)
    """

    stamps: Sequence[int]
    verdict: str
    sentence: str
    stations: int
    rms: float
    evidence: float
    probabilities: dict[str, float]
    target: Move
    sensor: Move
    points_off: float
    points_off_std: float
    contradicting: list[int]
    time_offset_changed: float = math.nan
    time_offset_changed_std: float = math.nan


def check_recording(profiles: Iterable[AnyProfile], poses: Sequence[TimedPose],
                    calibration: Calibration, config: Config) -> Check:
    """
    Return the check of a calibration by the stops of a recording, or by a sweep without stops.

    Raises DataError, and InputError for a calibration without a target to compare with.
    """
    # before samples of another target are sought
    cell = CalibratedCell.of_calibration(calibration, config)
    profiles = list(profiles)
    try:
        session = pipeline.gather(profiles, poses, config)
    except DataError as error:
        if error.code != 'no_stops' or not calibration.time_offset:
            raise
        config = replace(config, sampling=replace(config.sampling, mode='moving'))
        session = pipeline.gather(profiles, poses, config)
    if not config.sampling.moving:
        return check(session.samples, cell, session.rejects)
    answer = pipeline.answer_session(session, config)
    offset, solution = answer.require_calibration().time_offset, answer.require_solution()
    used = [answer.samples[i] for i in solution.used_stations]
    fixed_pose_samples = [replace(sample, trajectory=None)
                          for sample in evenly_spaced(used, MAX_OF_SWEEP)]
    result = check(fixed_pose_samples, cell, session.rejects,
                   [stop.stamp for stop in session.stops])
    before = calibration.time_offset
    return _with_offset(result, offset, before) if offset and before else result


def check(samples: Sequence[Sample], cell: CalibratedCell, rejects: Sequence[Reject] = (),
          pass_stamps: Sequence[int] = ()) -> Check:
    """
    Return the check of a calibration by samples of the same target; raises DataError.

    rejects: the stops that gave no sample; pass_stamps: the stamps (ns) of the passes of a sweep,
    of which the samples are single profiles.
    """
    problem, config = _observed(samples, cell, rejects), cell.config

    def compared_at(stops: Indices) -> GroupFit[_Prediction]:
        prediction = _predicted(problem.subset(stops), cell)
        station = prediction.linear.problem.observations.station
        require_stations([len(np.unique(station))])
        # whatever moved, and however the calibration errs
        wrt_moves = [prediction.residuals_without_move(part)[1] * _move_sigmas(MOVE_SCALES[-1])
                     for part in MOVABLE]
        return GroupFit(prediction, prediction.residuals,
                        np.hstack([prediction.wrt_errors, *wrt_moves]), stops[station])

    prediction, _, dropped = fit_without_outliers(
        np.unique(problem.observations.station), compared_at)

    target_cause, sensor_cause = (_cause_of(prediction, part) for part in MOVABLE)
    log_likelihoods = [target_cause.log_likelihood, sensor_cause.log_likelihood,
                       _robot_log_likelihood(prediction)]
    log_evidence = _log_mean(log_likelihoods) - _log_likelihood(
        prediction.residuals, prediction.wrt_errors)
    probabilities = dict(zip(CAUSES, softmax(log_likelihoods).tolist(), strict=True))
    off = rms(prediction.linear.residuals)
    if log_evidence >= math.log(MIN_EVIDENCE):
        verdict, sentence = _verdict_of_change(target_cause, sensor_cause, probabilities, off)
    else:
        verdict, sentence = 'unchanged', (
            'the calibration holds, and the target is where it was. A shift of the target would '
            f'have shown from {_shifts_in_words(target_cause.move, target_frame(config))} on, '
            f'one of the sensor from {_shifts_in_words(sensor_cause.move, mount_frame(config))} '
            'on')

    # the numbers of the stops or passes that hold what was dropped
    stamps = pass_stamps or [*(sample.stamp for sample in samples),
                             *(reject.stamp for reject in rejects)]
    contradicting = sorted({stop_number(samples[k].stamp, stamps) for k in dropped})
    if contradicting:
        what = 'profiles of the passes' if pass_stamps else 'stops'
        sentence += f'. Not used, as they contradict the others: {what} {contradicting}'
    return Check(
        [sample.stamp for sample in samples], verdict, sentence,
        len(prediction.linear.problem.poses), off, math.exp(min(log_evidence, 700.0)),
        probabilities, target_cause.move, sensor_cause.move, sensor_cause.displacement,
        sensor_cause.std, contradicting)


def _verdict_of_change(target_cause: _Cause, sensor_cause: _Cause,
                       probabilities: Mapping[str, float], off: float) -> tuple[str, str]:
    """
    Return the fewest causes that are together as probable as NAMED_FROM, and what follows.

    probabilities: of CAUSES; off: RMS of the residuals (m). Raises DataError where they are of
    another cell.
    """
    sentences = dict(zip(CAUSES, (
        target_cause.sentence, sensor_cause.sentence, ROBOT_CHANGED), strict=True))
    ranked = sorted(probabilities, key=probabilities.__getitem__, reverse=True)
    together = np.cumsum([probabilities[name] for name in ranked])
    named = ranked[:int(np.searchsorted(together, NAMED_FROM)) + 1]
    if 'robot' in named and off > MOVE_SCALES[-1]:
        raise DataError(
            f'this recording is off by {mm(off)} RMS from what the calibration has, which '
            'neither a small move nor an error of the robot explains: check that the '
            'calibration is of this sensor, robot and target, and that the target still '
            'stands there; if it does not, calibrate again', code='other_cell')
    sentence = '; or '.join(sentences[name] for name in named)
    if len(named) > 1:
        text = ', '.join(f'{name} {probabilities[name]:.0%}' for name in named)
        sentence = f'these stops cannot decide ({text}): {sentence}. {MORE_STOPS}'
    return ' or '.join(named), sentence


class CalibratedCell(NamedTuple):
    """
    Sensor and target as a calibration found them, and the settings of the check.

    root: R with R R' the joint covariance (6 + k, 6 + k) of transform and target
    variance_factors: (5,) of the noise that the calibration found, see NoiseModel, at least 1
    noise: the settings, with the sizes of systematic errors that it found
    """

    target: Target
    estimate: Estimate
    root: Array
    variance_factors: Array
    noise: NoiseConfig
    config: Config

    @classmethod
    def of_calibration(cls, calibration: Calibration, config: Config) -> CalibratedCell:
        """
        Return the cell of a stored calibration.

        Raises InputError where it holds no target, is of another target.type, or has a negative
        variance.
        """
        method, found, configured = calibration.method, calibration.target, config.noise
        if method != config.target.type and method in TARGETS:
            raise InputError(
                f'the calibration was made with a target of type {method}, but '
                f'target.type is {config.target.type}: without --config and --set target.type, '
                'its own settings apply')
        try:
            target, joint = TARGETS[method], found['joint']
            k = len(target.parameter_names)
            state = np.array(joint['state'], dtype=float).reshape(16 + k - len(target.pose_axes))
            covariance = np.array(joint['covariance'], dtype=float).reshape(6 + k, 6 + k)
            factors = np.maximum(np.ones(5), joint.get(
                'variance_factors', joint.get('variance_factor')))  # one, in earlier files
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f'the calibration (method {method}) does not hold what a check '
                'compares with: the target with its covariance. Solve its recording again with '
                f'this version, as one of {", ".join(TARGETS)}, or measure a known object with '
                '"handeye verify"') from error
        noise = replace(
            configured, robot_smooth=found.get(ROBOT_POSITION_ERROR, 0.0),
            distortion=found.get(DISTORTION_ERROR, configured.distortion),
            flatness=found.get(FLATNESS_ERROR, configured.flatness),
            line_bend=found.get(LINE_BEND, configured.line_bend))
        X = calibration.T_flange_sensor @ frames.T_sensor_plane(config)
        return cls(target, Estimate(X, state), covariance_root(covariance), factors, noise, config)


def _observed(samples: Sequence[Sample], cell: CalibratedCell, rejects: Sequence[Reject]
              ) -> Problem:
    """
    Return the samples as a problem, with only what they show of the calibrated target.

    Raises DataError for too few stations.
    """
    target, estimate, config = cell.target, cell.estimate, cell.config
    observations = target.observe(samples)
    problem = Problem(target, frames.mount_poses_of(samples, config), observations, config,
                      long_errors=True)
    require_stations([len(np.unique(observations.station))], rejects)
    p = problem.points_in_base(estimate.X)

    def labelled(groups: Indices) -> Problem:
        """Return the problem with the points of each group assigned to the edges near them."""
        kind = observations.kind.copy()
        for group in np.unique(groups):
            rows = groups == group
            kind[rows] = target.reassign(
                observations.select(rows), p[rows], estimate.state, config).kind
        return replace(problem, observations=replace(
            observations, kind=kind).select(kind != UNUSED))
    together = labelled(np.zeros_like(observations.station))
    # alone, the edge of a station is near whatever its distance: the target may have slid along
    # its face
    alone = labelled(observations.station)
    lost = has_unused_edges(alone, together)
    return alone if lost.mean() > MAX_LOST_SHARE else together


@dataclass(frozen=True, eq=False)
class _Prediction:
    """
    The residuals of a recording where a calibration is right and nothing has changed.

    linear: residuals and derivatives at the calibrated estimate
    whiten: multiplies by the inverse root of the covariance of the noise
    residuals: (m,) whitened residuals
    wrt_errors: (m, k) their whitened derivatives by the errors e, in sigmas of these
    """

    linear: Linearisation
    whiten: Whitening
    residuals: Array
    wrt_errors: Array

    def residuals_without_move(self, part: Part, move: Array = NO_MOVE
                               ) -> tuple[Array, Array, Array]:
        """
        Return the white residuals (m,) with a move (6,) of the target or the sensor undone.

        With their derivatives (m, 6) by the move, and the points (m, 3) relative to the centre of
        its turn: the middle of the points for the target, the sensor's origin for the sensor.
        """
        problem, calibrated = self.linear.problem, self.linear.estimate
        X = calibrated.X
        if part == 'sensor':
            linear = linearise(problem, replace(calibrated, X=se3.perturb(X, move)))
            wrt_move, lever = -linear.jacobian[:, :6], linear.lever
        else:
            centre = se3.transform(np.eye(3), problem.points_in_base(X).mean(axis=0))
            undone = centre @ se3.inverse(se3.perturb(np.eye(4), move)) @ se3.inverse(centre)
            linear = linearise(replace(problem, poses=undone @ problem.poses), calibrated)
            lever = linear.problem.points_in_base(X) - centre[:3, 3]
            wrt_move = np.hstack([linear.wrt_base, np.cross(lever, linear.wrt_base)])
        return self.whiten(linear.residuals), self.whiten(wrt_move), lever


def _predicted(problem: Problem, cell: CalibratedCell) -> _Prediction:
    """Return the residuals of a recording at the calibrated estimate, with their derivatives."""
    found_sizes = replace(problem, config=replace(cell.config, noise=cell.noise))
    at_found_sizes = linearise(found_sizes, cell.estimate)
    # the range of a face in grazing light may be off by as much as a calibration allows
    of_blocks = [
        block.columns * (block.largest_tau_squared ** 0.5 if block.name == GRAZING else 1.0)
        for source in (cell.target.blocks, sensor_distortion, line_bend)
        for block in source(at_found_sizes)]

    linear = linearise(problem, cell.estimate)
    whiten = whitening(linear, NoiseModel(cell.variance_factors))
    # what all stops share was part of the calibration too
    basis = problem.smooth_error_basis
    differences = (basis - basis.mean(axis=0))[problem.observations.station]
    wrt_errors = np.column_stack([
        linear.jacobian @ cell.root,
        wrt_smooth(linear.wrt_pose, differences * cell.noise.robot_smooth), *of_blocks])
    return _Prediction(linear, whiten, whiten(linear.residuals), whiten(wrt_errors))


def _log_likelihood(residuals: Array, *wrt_errors: Array) -> float:
    """
    Return the log likelihood of white residuals (m,) whose errors have a normal prior.

    wrt_errors: (m, k) each, derivatives by values of unit variance.
    """
    _, covariance, square = regularised_least_squares(np.hstack(wrt_errors), residuals)
    return float(np.linalg.slogdet(covariance)[1] - square) / 2


def _log_mean(logs: Sequence[float]) -> float:
    """Return the log of the mean of values, of which logs are the logs."""
    return float(np.logaddexp.reduce(logs) - math.log(len(logs)))


def _move_sigmas(scale: float) -> Array:
    """Return the prior sigmas (6,) of a move (m, rad) of a scale (m)."""
    return np.repeat([scale, scale / MOVE_TURN_LENGTH], 3)


class _Cause(NamedTuple):
    """
    The hypothesis that target or sensor moved.

    It has its log likelihood, the sentence for the user, the likeliest move, and the largest
    displacement of a point by it with 1 sigma, std (m).
    """

    log_likelihood: float
    sentence: str
    move: Move
    displacement: float
    std: float


def _cause_of(prediction: _Prediction, part: Part) -> _Cause:
    """
    Return the hypothesis that the target or the sensor moved.

    Gauss-Newton steps find the move; the scale of its prior is the likeliest of MOVE_SCALES.
    """
    move, sigmas = NO_MOVE, _move_sigmas(MOVE_SCALES[-1])
    for _ in range(STEP_COUNT):
        r, D, lever = prediction.residuals_without_move(part, move)
        r = r + D @ move  # of no move, in this linearisation
        x, C, _ = regularised_least_squares(np.hstack([prediction.wrt_errors, D * sigmas]), r)
        move, C = sigmas * x[-6:], C[-6:, -6:] * np.outer(sigmas, sigmas)
        log_likelihoods = [_log_likelihood(r, prediction.wrt_errors, D * _move_sigmas(scale))
                           for scale in MOVE_SCALES]
        sigmas = _move_sigmas(MOVE_SCALES[int(np.argmax(log_likelihoods))])
    shift, turn = np.linalg.norm(move.reshape(2, 3), axis=1).tolist()
    displacement, std = largest_displacement(lever, move, C)
    off, turned = f'{mm(displacement)} ± {mm(2 * std)}', f'{math.degrees(turn):.3f} degrees'
    on_flange = (part == 'sensor') == prediction.linear.problem.config.in_hand
    what = f'the {part} moved on the flange' if on_flange else (
        f'the {part}, or the base of the robot, moved')
    sentence = (
        f'{what} by {mm(shift)} and {turned}: points are off by up to {off}; calibrate again'
        if part == 'sensor' else
        f'{what} by up to {off} where it was seen, and turned by {turned}; the calibration holds')
    return _Cause(_log_mean(log_likelihoods), sentence,
                  Move(shift, turn, *_smallest_shifts(prediction, part)), displacement, std)


def _robot_log_likelihood(prediction: _Prediction) -> float:
    """Return the log likelihood of a robot whose poses err otherwise, smoothly or each alone."""
    problem, wrt_pose = prediction.linear.problem, prediction.whiten(prediction.linear.wrt_pose)
    smooth, station = problem.smooth_error_basis, problem.observations.station
    # the root of four is alike over twice the distance, as one joint's error reaches further
    values, axes = np.linalg.eigh(np.abs(smooth @ smooth.T) ** 0.25)
    roots = smooth, axes * np.sqrt(np.maximum(values, 0.0)), np.eye(len(problem.poses))
    return _log_mean([
        _log_likelihood(prediction.residuals, prediction.wrt_errors,
                        wrt_smooth(wrt_pose, root[station], np.diag(_move_sigmas(scale))))
        for root, scale in product(roots, MOVE_SCALES)])


def _smallest_shifts(prediction: _Prediction, part: Part) -> tuple[list[float], list[list[float]]]:
    """
    Return the smallest detectable shifts (3) of target or sensor, and their directions.

    The shifts are in metres, ascending, nan where none below UNSEEN_SHIFT shows; the directions
    (3, 3) are rows.
    """
    _, D, _ = prediction.residuals_without_move(part)
    A = prediction.wrt_errors  # a move that they explain as well does not show
    information = D.T @ (D - A @ np.linalg.solve(A.T @ A + np.eye(A.shape[1]), A.T @ D))
    occam = np.linalg.slogdet(np.eye(6) + information * _move_sigmas(TYPICAL_SCALE) ** 2)[1]
    # sigmas of a shift whose evidence reaches MIN_EVIDENCE after averaging over all causes and
    # scales, of which one explains it; and so that it is found in 95 % of the cases
    sigmas = ONE_SIDED_95 + np.sqrt(
        2 * np.log(len(CAUSES) * len(MOVE_SCALES) * MIN_EVIDENCE) + occam)
    values, axes = np.linalg.eigh(information[:3, :3])
    sizes = (sigmas / np.sqrt(np.maximum(values, 1e-300)))[::-1]
    return np.where(sizes < UNSEEN_SHIFT, sizes, np.nan).tolist(), axes.T[::-1].tolist()


def _shifts_in_words(move: Move, frame: str) -> str:
    """Return in words from which size on shifts along the axes show, and which do not."""
    along = [(size, direction_in_words(np.array(axis), frame))
             for size, axis in zip(move.shows, move.axes, strict=True)]
    unseen = ' or '.join(name for size, name in along if np.isnan(size))
    return ', '.join(f'{mm(size)} along {name}' for size, name in along if size < UNSEEN_SHIFT) + (
        f' (a slide along {unseen} cannot be seen)' if unseen else '')


def _with_offset(result: Check, offset: ClockEstimate, before: ClockEstimate) -> Check:
    """Return the check of a sweep with the change of its time offset since the calibration."""
    change, std = offset.value - before.value, math.hypot(offset.std, before.std)
    verdict = result.verdict
    text = f'{change * 1e3:+.2f} ms (1 sigma {std * 1e3:.2f})'
    sentence = f'The time offset is as it was: {text}'
    if abs(change) > max(SURE_CHANGE_SIGMAS * std, MIN_CHANGE):
        verdict = 'clock' if verdict == 'unchanged' else f'{verdict} and clock'
        sentence = (f'The time offset has changed by {text}: the clock or the delay of sensor or '
                    f'robot is another; set time_offset to {offset.value:.5f}, or calibrate again')
    return replace(result, verdict=verdict, time_offset_changed=change,
                   time_offset_changed_std=std, sentence=f'{result.sentence}. {sentence}')


def plain_values(checks: Sequence[tuple[str, Check]], against: str) -> dict[str, Any]:
    """Return checks, each with the name of its recording, as plain values."""
    contents = [{'input': recording, 'stamp': result.stamps[0], **asdict(result)}
                for recording, result in checks]
    for content in contents:
        del content['stamps']
        content['left_out'] = content.pop('contradicting')
        content['odds'] = content.pop('probabilities')
    for content, part in product(contents, MOVABLE):
        content |= {f'{part}_{key}': value for key, value in content.pop(part).items()}
    return {'format': FORMAT, 'against': against, 'checks': contents}
