"""
Whether a calibration still holds: a short recording of the target it was made with.

What the recording shows is compared with what the calibration expects there (see causes). The
sentence names the cause, or those that the stops cannot tell apart with their odds and the two
stops that would; where nothing changed, it says what change would have shown.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
import math
from typing import Any

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration, Sample, TimeOffset
from handeye_ros.errors import mm
from handeye_ros.estimation.model import Method
from handeye_ros.frames import mounted, sensor_axes
from handeye_ros.targets import METHODS
from handeye_ros.verification.causes import (
    agreeing,
    Cause,
    CAUSES,
    causes,
    Comparison,
    EVIDENCE,
    smallest_moves,
)
from handeye_ros.verification.clock import compared
from handeye_ros.verification.errors import NoCheckError, TooFewSeenError
from handeye_ros.verification.fixed_fit import by_calibration, points_in_base
from handeye_ros.verification.shapes import Seen
import numpy as np

FORMAT = 'handeye_ros/check/2'
LEAST_STATIONS = 4
SURE = 0.95  # probability with which one cause, or some together, are named
KEPT = 30  # samples of a sweep: neighbours share the errors of the robot
UNSEEN = 0.01  # m: a shift that would show only from here on is called unseen
TURNS = np.deg2rad([[0, 0, 90], [0, 0, 180], [0, 0, -90], [25, 0, 0], [-25, 0, 0], [0, 25, 0],
                    [0, -25, 0]])  # of a stop that may decide, about the sensor's axes


@dataclass(frozen=True)
class Check:
    """
    What a recording says of a calibration.

    verdict: unchanged, or the causes: target (it, or the robot's base, moved), sensor, robot
    (its poses err otherwise), with "or" between those that the stops cannot tell apart. evidence:
    how many times as likely the recording is with a change as without. odds: probability of each
    cause if something changed. target_moved (m), target_turned (rad): likeliest, were it the
    target; sensor_moved, sensor_turned: the same of the sensor in the flange; points_off: by how
    much points would then be off at most, and its std (m). target_shows, sensor_shows: from which
    shifts on it would have shown, along their axes (in the base, in the flange), m; nan: none
    would. rms: of the residuals (m). time_offset_changed: of a sweep, and its 1 sigma (s).
    """

    stamp: int
    verdict: str
    sentence: str
    stations: int
    rms: float
    evidence: float
    odds: dict[str, float]
    target_moved: float
    target_turned: float
    sensor_moved: float
    sensor_turned: float
    points_off: float
    points_off_std: float
    target_shows: list[float]
    target_axes: list[list[float]]
    sensor_shows: list[float]
    sensor_axes: list[list[float]]
    left_out: list[int]
    time_offset_changed: float = math.nan
    time_offset_changed_std: float = math.nan


def check(samples: Sequence[Sample], calibration: Calibration, config: Config, reason: str = ''
          ) -> Check:
    """
    Return what the samples of a recording say of a calibration made with the same target.

    reason: why other stations gave no sample. Raises NoCheckError, TooFewSeenError.
    """
    method = METHODS.get(calibration.method)
    joint = calibration.target.get('joint')
    if method is None or not isinstance(joint, Mapping):
        raise NoCheckError(calibration.method, list(METHODS))
    if len(samples) < LEAST_STATIONS:
        raise TooFewSeenError(len(samples), LEAST_STATIONS, reason)
    it, left_out = agreeing(_comparison(samples, calibration, method, joint, config))
    if len(np.unique(it.seen.observations.station)) < LEAST_STATIONS:
        raise TooFewSeenError(len(np.unique(it.seen.observations.station)), LEAST_STATIONS, reason)
    nothing, found = causes(it)
    return _judged(it, nothing, found, samples[0].stamp, [k + 1 for k in left_out])


def _comparison(samples: Sequence[Sample], calibration: Calibration, method: Method,
                joint: Mapping[str, Any], config: Config) -> Comparison:
    size = 6 + len(method.labels)
    try:
        state = np.array(joint['state'], dtype=float)
        covariance = np.array(joint['covariance'], dtype=float).reshape(size, size)
        scale = math.sqrt(max(float(joint['variance_factor']), 1.0))
    except (KeyError, TypeError, ValueError) as error:
        raise NoCheckError(calibration.method, list(METHODS)) from error
    seen = Seen(mounted(samples, config), method.features.observe(samples))
    return Comparison(method, seen, calibration.T_flange_sensor @ sensor_axes(config), state,
                      covariance, config, scale).labelled()


def _judged(it: Comparison, nothing: float, found: Sequence[Cause], stamp: int,
            left_out: list[int]) -> Check:
    likelihood = np.array([cause.likelihood for cause in found])
    evidence = float(np.logaddexp.reduce(likelihood) - np.log(len(found)) - nothing)
    odds = np.exp(likelihood - np.logaddexp.reduce(likelihood))
    order = np.argsort(-odds)
    few = order[:int(np.searchsorted(np.cumsum(odds[order]), SURE)) + 1]
    named = [found[k] for k in few]
    axes, shows = zip(*(smallest_moves(it, name) for name in ('target', 'sensor')), strict=True)
    target, sensor = found[:2]
    if evidence < math.log(EVIDENCE):
        verdict, sentence = 'unchanged', _unchanged(axes, shows)
    else:
        verdict = ' or '.join(cause.name for cause in named)
        sentence = '; or '.join(_said(it, cause) for cause in named)
        if len(named) > 1:
            chances = ', '.join(f'{CAUSES[k]} {odds[k]:.0%}' for k in few)
            sentence = f'these stops cannot decide ({chances}): {sentence}. {_deciding(it, named)}'
    p, kind = points_in_base(it.seen, it.X), it.seen.observations.kind
    if left_out:
        sentence += f'. Left out, as they contradict the others: stops {left_out}'
    g = it.method.geometry.conditions(p, kind, it.state, it.config).g
    return Check(stamp, verdict, sentence, len(np.unique(it.seen.observations.station)),
                 float(np.sqrt((g ** 2).mean())), math.exp(min(evidence, 700.0)),
                 dict(zip(CAUSES, map(float, odds), strict=True)), *_size(target), *_size(sensor),
                 sensor.displacement, sensor.displacement_std,
                 _finite(shows[0]), axes[0].tolist(), _finite(shows[1]), axes[1].tolist(),
                 left_out)


def _finite(shows: Array) -> list[float]:
    return [float(v) if v < UNSEEN else math.nan for v in shows]


def _size(cause: Cause) -> tuple[float, float]:
    return float(np.linalg.norm(cause.move[:3])), float(np.linalg.norm(cause.move[3:]))


def _said(it: Comparison, cause: Cause) -> str:
    moved, turned = _size(cause)
    off = f'{mm(cause.displacement)} ± {mm(2 * cause.displacement_std)}'
    if cause.name == 'target':
        return (f'the target, or the base of the robot, moved by up to {off} where it was seen, '
                f'and turned by {math.degrees(turned):.3f} degrees; the calibration holds')
    if cause.name == 'sensor':
        return (f'the sensor moved on the flange by {mm(moved)} and {math.degrees(turned):.3f} '
                f'degrees: points are off by up to {off}; calibrate again')
    return ('the poses of the robot err otherwise than before (mastering, a joint, wear), or '
            'repeat worse than noise.robot_* says: check the robot before the sensor')


def _unchanged(axes: Sequence[Array], shows: Sequence[Array]) -> str:
    """Return what would have shown, and what could not have."""
    moves = list(zip(shows[0], axes[0], strict=True))
    seen = [f'{mm(size)} along {_axis(axis)}' for size, axis in moves if size < UNSEEN]
    lost = [_axis(axis) for size, axis in moves if size >= UNSEEN]
    sensor = shows[1][-1]
    text = ('the calibration holds, and the target is where it was. Shifts of the target would '
            f'have shown from {", ".join(seen)} of the base on')
    text += f'; a slide along {" or ".join(lost)} cannot be seen' if lost else ''
    return text + ('; those of the sensor ' + (
        f'from {mm(sensor)} on in every direction' if sensor < UNSEEN else
        f'from {mm(shows[1][0])} on, but none along {_axis(axes[1][-1])} of the flange'))


def _axis(axis: Array) -> str:
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    if np.abs(axis).max() > 0.995:
        return 'xyz'[int(np.argmax(np.abs(axis)))]
    return '(' + ' '.join(f'{v:.2f}' for v in axis) + ')'


def _deciding(it: Comparison, named: Sequence[Cause]) -> str:
    """Return which two further stops tell two causes apart best, in words."""
    moves = {cause.name: cause.move for cause in named}
    if not {'target', 'sensor'} <= moves.keys():
        return ('Repeat the recording with the sensor turned by 90 degrees about its z at two of '
                'the stops: an error of the robot differs there, a move does not')
    seen, obs = it.seen, it.seen.observations
    rows = [int(np.flatnonzero(obs.station == s)[0]) for s in np.unique(obs.station)]
    p, centre = points_in_base(seen, it.X), points_in_base(seen, it.X).mean(axis=0)
    by_p = it.method.geometry.conditions(p, obs.kind, it.state, it.config).dg_dp
    lever = by_calibration(seen, it.X)
    best: dict[int, tuple[float, Array]] = {}
    for row, turn in product(rows, TURNS):
        R = seen.poses[obs.station[row], :3, :3] @ it.X[:3, :3]
        turned = R @ se3.exp_rotation(turn) @ R.T  # about the point that is seen
        by_sensor = -(turned @ lever[row]) @ moves['sensor']
        by_target = moves['target'][:3] + np.cross(moves['target'][3:], p[row] - centre)
        apart = abs(float(by_p[row] @ (by_sensor + by_target)))
        if apart > best.get(row, (0.0, turn))[0]:
            best[row] = (apart, turn)
    stops = sorted(best, key=lambda row: -best[row][0])[:2]
    return 'Two more stops would decide it: ' + ' and '.join(
        f'stop {int(obs.station[row]) + 1} again with the sensor turned by '
        f'{np.degrees(np.abs(best[row][1]).max()):.0f} degrees about its '
        f'{"xyz"[int(np.argmax(np.abs(best[row][1])))]}' for row in stops)


def with_offset(found: Check, now: TimeOffset, calibration: Calibration) -> Check:
    """Return a check with what a sweep says of the time offset."""
    before = calibration.time_offset
    if before is None:
        return found
    change, std = now.value - before.value, math.hypot(now.std, before.std)
    found = replace(found, time_offset_changed=change, time_offset_changed_std=std)
    changed, said = compared(now, before)
    if not changed:
        return replace(found, sentence=f'{found.sentence}. {said[0].upper()}{said[1:]}')
    if found.verdict == 'unchanged':
        return replace(found, verdict='clock', sentence=f'{said}. Apart from it {found.sentence}')
    return replace(found, verdict=f'{found.verdict} and clock',
                   sentence=f'{found.sentence}; {said}')


def some_of_sweep(samples: Sequence[Sample]) -> list[Sample]:
    """Return some of the samples of a sweep, evenly spread, as if the robot had stopped there."""
    every = -(-len(samples) // KEPT)
    return [replace(sample, motion=None) for sample in samples[every // 2::every]]


def values(checks: Sequence[tuple[str, Check]], against: str) -> dict[str, Any]:
    """Return checks, each with the name of its recording, as plain values."""
    return {'format': FORMAT, 'against': against,
            'checks': [{'input': name, **asdict(found)} for name, found in checks]}
