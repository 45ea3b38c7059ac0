"""From what was read of files to the calibration: the same refusals and the same report."""
from __future__ import annotations

from typing import Any

from handeye_ros import __version__, se3
from handeye_ros.checks.errors import LeftOutError, TooUncertainError
from handeye_ros.config import Config, flatten
from handeye_ros.data import Array, Calibration, Quality, SampleReport
from handeye_ros.files.method import Answer, FileMethod, Input
from handeye_ros.frames import mount_frame, name_direction, sensor_axes
from handeye_ros.se3 import worst_rotation, worst_translation
from handeye_ros.threads import single_threaded
import numpy as np


@single_threaded
def calibrate(method: FileMethod[Any], given: Input[Any], config: Config) -> Calibration:
    """Return the calibration; raises DataError when the files cannot carry an answer."""
    answer = method.solve(given.data, config)
    require_trusted(method, answer, config)
    provenance = {'version': __version__, 'inputs': list(given.inputs),
                  'config': flatten(config)}
    if given.warnings:
        provenance['warnings'] = list(given.warnings)
    return Calibration(
        config.name or config.target.type, method.name, mount_frame(config), given.frame,
        answer.X @ se3.inverse(plane_axes(method, config)), answer.covariance, answer.target,
        _quality(answer, config), _reports(method, given.data, answer), provenance)


def plane_axes(method: FileMethod[Any], config: Config) -> Array:
    """Return T_sensor_plane (4, 4), identity where the values are not of profiles."""
    return sensor_axes(config) if method.profiles else np.eye(4)


def require_trusted(method: FileMethod[Any], answer: Answer[Any], config: Config) -> None:
    """Refuse an answer beyond the limits; raises TooUncertainError and LeftOutError."""
    limits, frame = config.limits, mount_frame(config)
    turn, axis = worst_rotation(answer.covariance)
    if not turn <= limits.rotation:
        raise TooUncertainError.rotation(name_direction(axis, frame), turn, limits.rotation,
                                         method.advice)
    shift, direction = worst_translation(answer.covariance)
    if not shift <= limits.translation:
        raise TooUncertainError.translation(name_direction(direction, frame), shift,
                                            limits.translation, method.advice)
    if not answer.holdout_rms <= limits.residual:
        raise LeftOutError(answer.holdout_rms, answer.residual_rms, limits.residual)


def _quality(answer: Answer[Any], config: Config) -> Quality:
    std, direction = worst_translation(answer.covariance)
    used = int(answer.used.sum())
    return Quality(used, len(answer.used) - used, answer.residual_rms, answer.holdout_rms,
                   f'position along {name_direction(direction, mount_frame(config))} (m)', std)


def _reports(method: FileMethod[Any], data: Any, answer: Answer[Any]
             ) -> tuple[SampleReport, ...]:
    """Return what became of each sample; a row of a file has its number for a stamp."""
    reports = []
    for (stamp, kind), used, off in zip(method.samples(data), answer.used, answer.off,
                                        strict=True):
        reason = '' if used else 'contradicts the others'
        reports.append(SampleReport(stamp, bool(used), kind, float(off), reason))
    return tuple(reports)
