"""What a recording shows of an answer, stop by stop: what the report draws."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from handeye_ros import config as configuration
from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration, Feature, Sample
from handeye_ros.estimation.solution import Solution
from handeye_ros.results.calibration_file import input_values
from handeye_ros.results.outcome import left_out, measured_points
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class StopSnapshot:
    """
    A stop of the robot.

    number: counted from 1; T_mount: (4, 4) of what carries the sensor in what the target rests
    in; points: (n, 2) of one of its profiles, in the sensor plane; features: what was found in
    it; reason: why it was not used, empty if it was. residuals, left_out: (k,) of its measured
    points (metres), with and without it in the fit; empty where it was not used. samples: stamps
    of the samples of a robot that moved.
    """

    number: int
    stamp: int
    T_mount: Array
    points: Array
    features: tuple[Feature, ...] = ()
    reason: str = ''
    residuals: Array = field(default_factory=lambda: np.empty(0))
    left_out: Array = field(default_factory=lambda: np.empty(0))
    samples: tuple[int, ...] = ()

    @property
    def used(self) -> bool:
        """Return whether it is part of the answer."""
        return not self.reason


@dataclass(frozen=True, eq=False)
class Evidence:
    """
    The stops of a recording, and the answer that it gives.

    calibration: None where the recording is refused; refusal: with these words. missing: why
    there is no recording to show. sweep: (n, 3) of the samples of a robot that moved: time since
    the first (s), RMS residual (m), speed of the flange (m/s).
    """

    stops: tuple[StopSnapshot, ...] = ()
    calibration: Calibration | None = None
    refusal: str = ''
    missing: str = ''
    sweep: Array = field(default_factory=lambda: np.empty((0, 3)))


def recording_of(calibration: Calibration) -> tuple[Path | None, str]:
    """Return the recording that a calibration names, None and the reason if it is not there."""
    advice = 'so its stops are not shown: name the recording with --bag'
    for item in calibration.provenance.get('inputs', ()):
        path = Path(str(item.get('path', '')))
        if not item.get('path'):
            continue
        if not path.is_file():
            return None, f'{path} is not there, {advice}'
        if input_values(path)['sha256'] != item.get('sha256'):
            return None, f'{path} has changed since it was solved, {advice}'
        return path, ''
    return None, f'the calibration names no recording, {advice}'


def config_of(calibration: Calibration) -> Config:
    """Return the configuration that a calibration was made with, as far as it says so."""
    return configuration.from_provenance(calibration.provenance.get('config'))


def use_config(calibration: Calibration, config: Config | None = None) -> Config:
    """
    Return the configuration for what is measured with a calibration: with its time offset.

    config: another than it was made with.
    """
    config = config or config_of(calibration)
    if calibration.time_offset:
        config = replace(config, time_offset=calibration.time_offset.value)
    still = config.sampling.mode if not config.sampling.moving else 'still'
    return replace(config, sampling=replace(config.sampling, mode=still))


def judged(stops: Sequence[StopSnapshot], used: Sequence[Sample], solution: Solution,
           calibration: Calibration) -> Evidence:
    """
    Return stops with what became of them in an answer.

    used: the samples of the answer, in the order of the stations of its problem.
    """
    measured = measured_points(used, solution.problem)
    inside = measured.residuals(solution.problem, solution.estimate, solution.corrected_poses())
    outside = left_out(solution, measured)
    reasons = {report.stamp: report.reason for report in calibration.samples if not report.used}
    found = [replace(stop, reason=reasons.get(stop.stamp, stop.reason)) for stop in stops]
    place = {stamp: i for i, stop in enumerate(found) for stamp in stop.samples or (stop.stamp,)}
    at = np.array([place[sample.stamp] for sample in used])[measured.station]
    for i in np.unique(at).tolist():
        found[i] = replace(found[i], reason='', residuals=inside[at == i],
                           left_out=outside[at == i])
    return Evidence(tuple(found), calibration, sweep=_sweep(used, measured.station, inside))


def _sweep(used: Sequence[Sample], station: NDArray[np.intp], residuals: Array) -> Array:
    """Return time, RMS residual and speed of the samples of a robot that moved."""
    squares, count = (np.bincount(station, each, len(used)) for each in (residuals ** 2, None))
    rms = np.sqrt(squares / np.maximum(count, 1))
    moving = [i for i, sample in enumerate(used) if sample.motion is not None]
    if not moving:
        return np.empty((0, 3))
    at = np.array([used[i].stamp + round(used[i].offsets[0] * 1e9) for i in moving])
    twists = used[moving[0]].motion.at(at).twists
    return np.column_stack([(at - at[0]) * 1e-9, rms[moving],
                            np.linalg.norm(twists[:, :3], axis=1)])
