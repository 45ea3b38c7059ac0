# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether a calibration still holds, by a short recording of its target.

The recording is compared with what the calibration predicts for it (see causes). The sentence
names the cause. If the stops do not distinguish several causes, it names these and their odds.
If nothing changed, it states the smallest change
that the check would have detected.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
import math
from typing import Any

from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration, Sample, TimeOffset
from handeye_ros.errors import InputError, mm
from handeye_ros.estimation.problem import Target, UNUSED
from handeye_ros.frames import mounted, sensor_axes
from handeye_ros.targets import METHODS
from handeye_ros.verification.causes import (
    agreeing,
    Cause,
    causes,
    Comparison,
    EVIDENCE,
    smallest_moves,
)
from handeye_ros.verification.shapes import StationSet
from handeye_ros.verification.stations import compared
from handeye_ros.verification.verify import too_few
import numpy as np

FORMAT = 'handeye_ros/check/2'
LEAST_STATIONS = 4
SURE = 0.95  # probability with which one cause, or some together, are named
KEPT = 30  # samples of a sweep: neighbours share the errors of the robot
UNSEEN = 0.01  # m: a shift that would show only from here on is called unseen
MORE = ('Repeat some of them with the sensor turned by 90 degrees about its z, and by 25 degrees '
        'about x and y: an error of the robot differs there, a move does not')


@dataclass(frozen=True)
class Check:
    """
    Result of a check.

    verdict: unchanged, or the causes: target (it, or the robot's base, moved), sensor, robot
    (its pose errors changed), with "or" between those that the stops do not distinguish.
    evidence: how many times as likely the recording is with a change as without. odds: probability
    of each cause if something changed. target_moved (m), target_turned (rad): the most likely move
    if the target is the cause; sensor_moved, sensor_turned: the same for the sensor in the flange;
    points_off: the largest error of points in this case, and its std (m). target_shows,
    sensor_shows: smallest detectable shifts along their axes (in the base, in the flange), m; nan:
    not detectable. rms: of the residuals (m). time_offset_changed: of a sweep, and its 1 sigma
    (s).
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
    Return the check of a calibration by samples of the same target.

    reason: why other stations gave no sample. Raises DataError, and InputError for a calibration
    without a target to compare with.
    """
    method = METHODS.get(calibration.method)
    joint = calibration.target.get('joint')
    if method is None or not isinstance(joint, Mapping):
        raise _no_target(calibration)
    if len(samples) < LEAST_STATIONS:
        raise too_few(len(samples), LEAST_STATIONS, reason)
    comparison, left_out = agreeing(_comparison(samples, calibration, method, joint, config))
    count = len(np.unique(comparison.stations.observations.station))
    if count < LEAST_STATIONS:
        raise too_few(count, LEAST_STATIONS, reason)
    unchanged, explanations = causes(comparison)
    return _result(comparison, unchanged, explanations, samples[0].stamp,
                   [k + 1 for k in left_out])


def _comparison(samples: Sequence[Sample], calibration: Calibration, method: Target,
                joint: Mapping[str, Any], config: Config) -> Comparison:
    size = 6 + len(method.labels)
    try:
        state = np.array(joint['state'], dtype=float)
        covariance = np.array(joint['covariance'], dtype=float).reshape(size, size)
        scale = math.sqrt(max(float(joint['variance_factor']), 1.0))
    except (KeyError, TypeError, ValueError) as error:
        raise _no_target(calibration) from error
    stations = StationSet(mounted(samples, config), method.observe(samples))
    X = calibration.T_flange_sensor @ sensor_axes(config)
    obs = method.relabel(stations.observations, stations.points(X), state, config)
    stations = replace(stations, observations=obs.select(obs.kind != UNUSED))
    return Comparison(method, stations, X, state, covariance, config, scale)


def _no_target(calibration: Calibration) -> InputError:
    return InputError(
        f'the calibration (method {calibration.method}) does not hold what a check compares with: '
        'the target with its covariance. Solve its recording again with this version, as one of '
        f'{", ".join(METHODS)}, or measure a known object with "handeye verify"')


def _result(comparison: Comparison, unchanged: float, explanations: Sequence[Cause], stamp: int,
            left_out: list[int]) -> Check:
    likelihood = np.array([cause.likelihood for cause in explanations])
    evidence = float(np.logaddexp.reduce(likelihood) - np.log(len(explanations)) - unchanged)
    odds = np.exp(likelihood - np.logaddexp.reduce(likelihood))
    order = np.argsort(-odds)
    likeliest = order[:int(np.searchsorted(np.cumsum(odds[order]), SURE)) + 1]
    named = [explanations[k] for k in likeliest]
    axes, detectable = zip(*(smallest_moves(comparison, name) for name in ('target', 'sensor')),
                           strict=True)
    target, sensor = explanations[:2]
    if evidence < math.log(EVIDENCE):
        verdict, sentence = 'unchanged', _unchanged(axes, detectable)
    else:
        verdict = ' or '.join(cause.name for cause in named)
        sentence = '; or '.join(map(_cause_sentence, named))
        if len(named) > 1:
            text = ', '.join(f'{explanations[k].name} {odds[k]:.0%}' for k in likeliest)
            sentence = f'these stops cannot decide ({text}): {sentence}. {MORE}'
    if left_out:
        sentence += f'. Left out, as they contradict the others: stops {left_out}'
    g = comparison.conditions(comparison.points).g
    count = len(np.unique(comparison.stations.observations.station))
    return Check(stamp, verdict, sentence, count, float(np.sqrt((g ** 2).mean())),
                 math.exp(min(evidence, 700.0)),
                 {cause.name: float(p) for cause, p in zip(explanations, odds, strict=True)},
                 *target.size, *sensor.size, sensor.displacement, sensor.displacement_std,
                 _finite(detectable[0]), axes[0].tolist(), _finite(detectable[1]),
                 axes[1].tolist(), left_out)


def _finite(detectable: Array) -> list[float]:
    return [float(v) if v < UNSEEN else math.nan for v in detectable]


def _cause_sentence(cause: Cause) -> str:
    shift, rotation = cause.size
    off = f'{mm(cause.displacement)} ± {mm(2 * cause.displacement_std)}'
    if cause.name == 'target':
        return (f'the target, or the base of the robot, moved by up to {off} where it was seen, '
                f'and turned by {math.degrees(rotation):.3f} degrees; the calibration holds')
    if cause.name == 'sensor':
        return (f'the sensor moved on the flange by {mm(shift)} and {math.degrees(rotation):.3f} '
                f'degrees: points are off by up to {off}; calibrate again')
    return ('the poses of the robot err otherwise than before (mastering, a joint, wear), or '
            'repeat worse than noise.robot_* says: check the robot before the sensor')


def _unchanged(axes: Sequence[Array], detectable: Sequence[Array]) -> str:
    """Return which changes were detectable, and which were not."""
    moves = list(zip(detectable[0], axes[0], strict=True))
    visible = [f'{mm(size)} along {_axis(axis)}' for size, axis in moves if size < UNSEEN]
    invisible = [_axis(axis) for size, axis in moves if size >= UNSEEN]
    sensor = detectable[1][-1]
    text = ('the calibration holds, and the target is where it was. Shifts of the target would '
            f'have shown from {", ".join(visible)} of the base on')
    text += f'; a slide along {" or ".join(invisible)} cannot be seen' if invisible else ''
    return text + ('; those of the sensor ' + (
        f'from {mm(sensor)} on in every direction' if sensor < UNSEEN else
        f'from {mm(detectable[1][0])} on, but none along {_axis(axes[1][-1])} of the flange'))


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
