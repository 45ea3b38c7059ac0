"""
Whether a calibration still holds, by a short recording of its target.

r = g(p; target) are the residuals of the recording at the answer of the calibration. With nothing
changed, r = G dX + J deta + e: dX, deta are the errors of the calibration's transform and target
with their joint covariance, e is the noise of sensor and robot. Two more fits free a move m (6,)
of the target, or of the sensor. The fits are compared by chi-squared plus log(n) for each freed
direction (BIC). No fit that agrees with the noise: the poses of the robot err otherwise than
before.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
import math
from typing import Any

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration, Sample, TimeOffset
from handeye_ros.errors import InputError, mm
from handeye_ros.estimation.model import Conditions, Method, UNUSED
from handeye_ros.estimation.outliers import chi2_sf
from handeye_ros.frames import mounted, sensor_axes
from handeye_ros.targets import METHODS
from handeye_ros.targets.common import edges_of
from handeye_ros.verification.fixed_fit import (
    by_calibration,
    noise_factors,
    points_in_base,
    root_of,
    white,
)
from handeye_ros.verification.samples import compared
from handeye_ros.verification.shapes import StationSet
from handeye_ros.verification.verify import too_few
import numpy as np
from numpy.typing import NDArray

FORMAT = 'handeye_ros/check/3'
LEAST_STATIONS = 4
EVIDENCE = 2 * math.log(100.0)  # by which a changed fit must be better (BIC); see bench/check.py
CLOSE = 2 * math.log(19.0)  # a fit that is worse by less is named too
UNEXPLAINED = 1e-4  # p of the unchanged fit: below it something has changed in any case
AGREES = 0.05  # smallest p of a fit that explains the recording; of a true cause: bench/check.py
MOVE = np.repeat([1e-3, 1e-2], 3)  # m, rad: a move that would not show with 1 sigma is not freed
ITERATIONS = 6
RANK = 1e-9
OUTLIER = 0.01  # probability that any good stop is left out
MOST_OUTLIERS = 0.15  # of the stops
WIDE = 10 * MOVE  # 1 sigma of target and sensor, while outliers are searched
KEPT = 30  # samples of a sweep: neighbours share the errors of the robot
UNSEEN = 0.01  # m: a shift that would show only from here on is called unseen
STILL = np.zeros(6)  # no move


@dataclass(frozen=True)
class Check:
    """
    Result of a check.

    verdict: unchanged; target (it, or the robot's base, moved), sensor (moved on the flange), with
    "or" where the stops do not distinguish them; robot (its pose errors changed); in a sweep also
    clock. p: of the recording under each fit. target_moved (m), target_turned (rad), and
    sensor_moved, sensor_turned in the flange: the most likely move if this is the cause;
    points_off: the largest error of points by the sensor's move, and its std (m). target_shows,
    sensor_shows: smallest detectable shifts along their axes (in the base, in the flange), m; nan:
    not detectable. rms: of the residuals (m). time_offset_changed: of a sweep, and its 1 sigma
    (s).
    """

    stamp: int
    verdict: str
    sentence: str
    stations: int
    rms: float
    p: dict[str, float]
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


@dataclass(frozen=True, eq=False)
class _Comparison:
    """
    A recording with the calibration that it is compared with.

    X (4, 4), state (s,): calibrated sensor plane in the mount, and calibrated target; root
    (6 + k, 6 + k): of their joint covariance; noise_scale: factor of the stated noise.
    """

    method: Method
    stations: StationSet
    X: Array
    state: Array
    root: Array
    config: Config
    noise_scale: float

    @cached_property
    def points(self) -> Array:
        """Return the positions (m, 3) of the observed points in the base."""
        return points_in_base(self.stations, self.X)

    @property
    def numbers(self) -> list[int]:
        """Return the indices of the stations with observations."""
        return [int(k) for k in np.unique(self.stations.observations.station)]

    def conditions(self, p: Array) -> Conditions:
        """Return residuals and derivatives of points p (m, 3) in the base."""
        return self.method.geometry.conditions(p, self.stations.observations.kind, self.state,
                                               self.config)


@dataclass(frozen=True, eq=False)
class _Rows:
    """
    Whitened residuals r (m,) of the stations (m,), reduced to a few rows of each.

    target, sensor (m, 6): their change by a move that is taken back; covariance (m, m): of r by
    noise and by the calibration's errors, without a change.
    """

    r: Array
    target: Array
    sensor: Array
    covariance: Array
    station: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class _Fit:
    """A fit: its cost (BIC), its p, the move (6,) with its covariance; name: what moved."""

    name: str
    cost: float
    p: float
    move: Array
    covariance: Array


def check(samples: Sequence[Sample], calibration: Calibration, config: Config, reason: str = ''
          ) -> Check:
    """
    Return the check of a calibration by samples of the same target.

    reason: why other stations gave no sample. Raises DataError, and InputError for a calibration
    without a target to compare with.
    """
    if len(samples) < LEAST_STATIONS:
        raise too_few(len(samples), LEAST_STATIONS, reason)
    comparison, left_out = _agreeing(_comparison(samples, calibration, config))
    if len(comparison.numbers) < LEAST_STATIONS:
        raise too_few(len(comparison.numbers), LEAST_STATIONS, reason)
    fits = unchanged, target, sensor = [
        _fit(comparison, name) for name in ('unchanged', 'target', 'sensor')]
    shows = {name: _smallest_shifts(comparison, name) for name in ('target', 'sensor')}
    if (min(target.cost, sensor.cost) > unchanged.cost - EVIDENCE
            and unchanged.p > UNEXPLAINED):
        verdict, sentence = 'unchanged', _unchanged_sentence(shows)
    else:
        named = sorted((fit for fit in (target, sensor) if fit.p > AGREES),
                       key=lambda fit: fit.cost)
        named = [fit for fit in named if fit.cost < named[0].cost + CLOSE]
        verdict = ' or '.join(fit.name for fit in named) or 'robot'
        sentence = '; or '.join(_cause_sentence(comparison, fit) for fit in named) or (
            'no move of target or sensor explains these stops: the poses of the robot err '
            'otherwise than before (mastering, a joint, wear), or repeat worse than noise.robot_* '
            'says: check the robot before the sensor')
        if len(named) > 1:
            sentence = ('these stops cannot decide (repeat some with the sensor turned about its '
                        f'z): {sentence}')
    numbers = [k + 1 for k in left_out]
    if left_out:
        sentence += f'. Left out, as they contradict the others: stops {numbers}'
    g = comparison.conditions(comparison.points).g
    off, off_std = _displacement(comparison, sensor)
    return Check(
        samples[0].stamp, verdict, sentence, len(comparison.numbers),
        float(np.sqrt((g ** 2).mean())), {fit.name: fit.p for fit in fits},
        target_moved=_size(target.move[:3]), target_turned=_size(target.move[3:]),
        sensor_moved=_size(sensor.move[:3]), sensor_turned=_size(sensor.move[3:]),
        points_off=off, points_off_std=off_std,
        target_shows=_seen(shows['target'][0]), target_axes=shows['target'][1].tolist(),
        sensor_shows=_seen(shows['sensor'][0]), sensor_axes=shows['sensor'][1].tolist(),
        left_out=numbers)


def _size(vector: Array) -> float:
    return float(np.linalg.norm(vector))


def _seen(shifts: Array) -> list[float]:
    return [float(shift) if shift < UNSEEN else math.nan for shift in shifts]


def _comparison(samples: Sequence[Sample], calibration: Calibration, config: Config
                ) -> _Comparison:
    """Return the recording with its observations assigned to the parts of the target."""
    try:
        method, joint = METHODS[calibration.method], calibration.target['joint']
        size = 6 + len(method.labels)
        state = np.array(joint['state'], dtype=float)
        covariance = np.array(joint['covariance'], dtype=float).reshape(size, size)
        scale = math.sqrt(max(float(joint['variance_factor']), 1.0))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f'the calibration (method {calibration.method}) does not hold what a check compares '
            'with: the target with its covariance. Solve its recording again with this version, '
            f'as one of {", ".join(METHODS)}, or measure a known object with "handeye verify"'
        ) from error
    X = calibration.T_flange_sensor @ sensor_axes(config)
    stations = StationSet(mounted(samples, config), method.features.observe(samples))
    obs = method.geometry.relabel(stations.observations, points_in_base(stations, X), state,
                                  config)
    stations = replace(stations, observations=obs.select(obs.kind != UNUSED))
    return _Comparison(method, stations, X, state, root_of(covariance), config, scale)


def _rows(comparison: _Comparison, name: str = 'unchanged', move: Array = STILL) -> _Rows:
    """Return the residuals after a move of the target or the sensor."""
    X = se3.perturb(comparison.X, move) if name == 'sensor' else comparison.X
    stations, obs = comparison.stations, comparison.stations.observations
    points = p = points_in_base(stations, X)
    centre, noise = comparison.points.mean(axis=0), comparison.config.noise
    back = np.eye(3)
    if name == 'target':  # it turns about the middle of its points
        back = se3.exp_rotation(-move[3:])
        p = (p - centre - move[:3]) @ back.T + centre
    conditions = comparison.conditions(p)
    by_p = conditions.dg_dp @ back
    G = np.einsum('mi,mij->mj', by_p, by_calibration(stations, X))
    target = np.hstack([by_p, se3.cross(p - centre, conditions.dg_dp)])
    by_pose = np.hstack([by_p, se3.cross(points - stations.poses[obs.station, :3, 3], by_p)])
    by_errors = np.hstack([np.hstack([G, conditions.dg_dtarget]) @ comparison.root,
                           _setbacks(comparison, X, by_p)])
    # the error of the sensor's field differs from stop to stop, as that of the pose does
    blocks = noise_factors(stations, X, by_p, noise, noise.distortion)
    columns = white(blocks, np.hstack([conditions.g[:, None], by_errors, target, -G, by_pose])
                    ) / comparison.noise_scale
    reduced, station = [], []
    for number in comparison.numbers:  # within a stop, only what a pose could change
        rows = columns[obs.station == number]
        U, s, _ = np.linalg.svd(rows[:, 1:], full_matrices=False)
        reduced.append(U[:, s > RANK * s[0]].T @ rows)
        station.append(np.full(len(reduced[-1]), number))
    r, by_errors, target, sensor, _ = np.split(
        np.concatenate(reduced), np.cumsum([1, by_errors.shape[1], 6, 6]), axis=1)
    return _Rows(r[:, 0], target, sensor, np.eye(len(r)) + by_errors @ by_errors.T,
                 np.concatenate(station))


def _setbacks(comparison: _Comparison, X: Array, by_p: Array) -> Array:
    """Return the set-backs (m, e) of the ends of each kind at each edge, 1 sigma."""
    obs = edges_of(comparison.stations.observations)
    R = comparison.stations.poses[obs.station, :3, :3]
    out = np.einsum('mi,mij,jk,mk->m', by_p, R, X[:3, [0, 2]], obs.outward)
    groups = {(int(k), int(e)) for k, e in zip(obs.kind, obs.end, strict=True) if e}
    columns = [np.where((obs.kind == k) & (obs.end == e), out, 0.0) for k, e in sorted(groups)]
    return comparison.config.target.setback_std * np.reshape(columns, (-1, len(out))).T


def _agreeing(comparison: _Comparison) -> tuple[_Comparison, list[int]]:
    """
    Return the comparison without stops that contradict the others, and their indices.

    By their leave-one-out residuals, with target and sensor free to have moved.
    """
    kept, left_out = comparison, list[int]()
    while len(left_out) < int(MOST_OUTLIERS * len(comparison.numbers)):
        rows = _rows(kept)
        moves = np.hstack([rows.target * WIDE, rows.sensor * WIDE])
        W = np.linalg.inv(rows.covariance + moves @ moves.T)
        p = {}
        for k in kept.numbers:
            members = np.flatnonzero(rows.station == k)
            residual = W[members] @ rows.r
            square = residual @ np.linalg.solve(W[np.ix_(members, members)], residual)
            p[k] = float(chi2_sf(square, len(members)))
        worst = min(p, key=p.__getitem__)
        if p[worst] * len(p) > OUTLIER:
            break
        left_out.append(worst)
        kept = replace(comparison, stations=comparison.stations.without(left_out))
    return kept, left_out


def _fit(comparison: _Comparison, name: str) -> _Fit:
    """Return the fit with nothing moved, or with what has this name moved."""
    move, covariance, freed = STILL, np.zeros((6, 6)), 0
    for _ in range(ITERATIONS):
        rows = _rows(comparison, name, move)
        factor = np.linalg.cholesky(rows.covariance)
        if name == 'unchanged':
            rest = np.linalg.solve(factor, rows.r)
            break
        D = getattr(rows, name)
        linear = np.linalg.solve(factor, rows.r + D @ move)
        U, s, Vt = np.linalg.svd(np.linalg.solve(factor, D * MOVE), full_matrices=False)
        freed = int((s > 1).sum())
        V = MOVE[:, None] * Vt[:freed].T / s[:freed]
        move, covariance = V @ (U[:, :freed].T @ linear), V @ V.T
        rest = linear - U[:, :freed] @ (U[:, :freed].T @ linear)
    square, n = float(rest @ rest), len(rest)
    return _Fit(name, square + freed * math.log(n), float(chi2_sf(square, max(n - freed, 1))),
                move, covariance)


def _displacement(comparison: _Comparison, fit: _Fit) -> tuple[float, float]:
    """Return the largest displacement of a point by a move, and its 1 sigma (m)."""
    by_move = by_calibration(comparison.stations, comparison.X)
    if fit.name == 'target':
        offset = comparison.points - comparison.points.mean(axis=0)
        by_move = np.concatenate([np.broadcast_to(np.eye(3), by_move[..., 3:].shape),
                                  -se3.skew(offset)], axis=2)
    displacements = np.linalg.norm(by_move @ fit.move, axis=1)
    worst = by_move[int(np.argmax(displacements))]
    return float(displacements.max()), math.sqrt(np.trace(worst @ fit.covariance @ worst.T))


def _smallest_shifts(comparison: _Comparison, name: str) -> tuple[Array, Array]:
    """
    Return the smallest detectable shifts (3,) and, as rows, their axes (3, 3).

    Of the target in the base, of the sensor in the flange; the smallest first.
    """
    rows = _rows(comparison)
    D = getattr(rows, name)
    information = D.T @ np.linalg.solve(rows.covariance, D)
    freed = (np.linalg.eigvalsh(information * np.outer(MOVE, MOVE)) > 1).sum()
    sigmas = math.sqrt(EVIDENCE + freed * math.log(len(rows.r))) + 1.64  # with 95 %
    values, axes = np.linalg.eigh(information[:3, :3])
    return (sigmas / np.sqrt(np.maximum(values, 1e-300)))[::-1], axes.T[::-1]


def _cause_sentence(comparison: _Comparison, fit: _Fit) -> str:
    size, std = _displacement(comparison, fit)
    off, turn = f'{mm(size)} ± {mm(2 * std)}', math.degrees(_size(fit.move[3:]))
    if fit.name == 'target':
        return (f'the target, or the base of the robot, moved by up to {off} where it was seen, '
                f'and turned by {turn:.3f} degrees; the calibration holds')
    return (f'the sensor moved on the flange by {mm(_size(fit.move[:3]))} and '
            f'{turn:.3f} degrees: points are off by up to {off}; calibrate again (an offset of '
            "the robot's last joints looks alike)")


def _unchanged_sentence(shows: Mapping[str, tuple[Array, Array]]) -> str:
    """Return which changes were detectable, and which were not."""
    (target, axes), (sensor, sensor_axes) = shows['target'], shows['sensor']
    visible = [f'{mm(size)} along {_axis(axis)}' for size, axis in zip(target, axes, strict=True)
               if size < UNSEEN]
    hidden = [_axis(axis) for size, axis in zip(target, axes, strict=True) if size >= UNSEEN]
    text = ('the calibration holds, and the target is where it was. Shifts of the target would '
            f'have shown from {", ".join(visible)} of the base on')
    text += f'; a slide along {" or ".join(hidden)} cannot be seen' if hidden else ''
    return f'{text}; those of the sensor ' + (
        f'from {mm(sensor[-1])} on in every direction' if sensor[-1] < UNSEEN else
        f'from {mm(sensor[0])} on, but none along {_axis(sensor_axes[-1])} of the flange')


def _axis(axis: Array) -> str:
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    if np.abs(axis).max() > 0.995:
        return 'xyz'[int(np.argmax(np.abs(axis)))]
    return '(' + ' '.join(f'{v:.2f}' for v in axis) + ')'


def with_offset(result: Check, offset: TimeOffset, calibration: Calibration) -> Check:
    """Return a check with the time offset of a sweep."""
    previous = calibration.time_offset
    if previous is None:
        return result
    change, std = offset.value - previous.value, math.hypot(offset.std, previous.std)
    result = replace(result, time_offset_changed=change, time_offset_changed_std=std)
    changed, sentence = compared(offset, previous)
    if not changed:
        return replace(result, sentence=f'{result.sentence}. {sentence[0].upper()}{sentence[1:]}')
    if result.verdict == 'unchanged':
        return replace(result, verdict='clock',
                       sentence=f'{sentence}. Apart from it {result.sentence}')
    return replace(result, verdict=f'{result.verdict} and clock',
                   sentence=f'{result.sentence}; {sentence}')


def some_of_sweep(samples: Sequence[Sample]) -> list[Sample]:
    """Return some samples of a sweep, evenly spaced, as samples of stops."""
    step = -(-len(samples) // KEPT)
    return [replace(sample, motion=None) for sample in samples[step // 2::step]]


def values(checks: Sequence[tuple[str, Check]], against: str) -> dict[str, Any]:
    """Return checks, each with the name of its recording, as plain values."""
    return {'format': FORMAT, 'against': against,
            'checks': [{'input': name, **asdict(result)} for name, result in checks]}
