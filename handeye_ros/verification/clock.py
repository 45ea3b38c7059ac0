"""The time offset of a sweep over an artefact against that of the calibration."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import math

from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration, Sample, TimeOffset
from handeye_ros.estimation.solver import Rows, System
from handeye_ros.frames import in_mount, mounted
from handeye_ros.sampling.passes import Pairing, single_samples
from handeye_ros.sampling.time_offset import evenly_chosen
from handeye_ros.verification.fixed_fit import points_in_base
from handeye_ros.verification.routines import Routine
from handeye_ros.verification.shapes import derivatives, Seen
import numpy as np
from numpy.typing import NDArray

SURE = 4.0  # sigmas of a change
SMALLEST = 1e-4  # s: of no matter to a scan
MOST = 60  # samples of a sweep
OUTLIER, FOREIGN = 4.0, 20.0  # robust scatters of the points: not counted; of another surface
ROUNDS = 4  # of fits without the outliers of the one before
TOGETHER = 1_000_000_000  # ns, over which residuals are not independent


def at_offset(routine: Routine, samples: Sequence[Sample], X: Array, calibration: Calibration,
              config: Config) -> tuple[list[Sample], str]:
    """
    Return samples of a robot that moves with the poses of the time offset that fits best.

    X: (4, 4) sensor plane in the mount. Without those that show another surface or edge: single
    profiles do where a stop would not. And whether the offset is that of the calibration, in
    words.
    """
    samples = single_samples(samples)
    samples = [samples[i] for i in evenly_chosen(len(samples), MOST)]
    poses = mounted(samples, config)
    seen = Seen(poses, routine.observe(samples, poses, X))
    offset, std, foreign = _fitted(routine, samples, seen, X, config)
    T = Pairing.of(samples).at(offset).T_base_flange
    now = TimeOffset(config.time_offset + offset, std)
    before = calibration.time_offset or TimeOffset(config.time_offset, 0.0)
    says = compared(now, before)[1]
    if foreign.any():
        says += f'; {foreign.sum()} of {len(samples)} profiles show another surface'
    return [replace(sample, T_base_flange=pose, motion=None) for sample, pose, out in
            zip(samples, T, foreign, strict=True) if not out], says


def _fitted(routine: Routine, samples: Sequence[Sample], seen: Seen, X: Array, config: Config
            ) -> tuple[float, float, NDArray[np.bool_]]:
    """
    Return the offset with which the shape of a routine fits best, and its 1 sigma (s).

    And which samples (n,) hold a point of something else.
    """
    pairing, obs = Pairing.of(samples), seen.observations
    _, shape = routine.shape(seen, points_in_base(seen, X), config.verify)

    def distances(x: Array) -> Array:
        poses = in_mount(pairing.at(x[-1]).T_base_flange, config)
        points = points_in_base(replace(seen, poses=poses), X)
        return shape.distance(points, obs.kind, x[:-1])

    def fitted(x: Array, kept: NDArray[np.bool_]) -> Array:
        system: System[Array] = System(
            lambda at: Rows(distances(at)[kept], lambda: derivatives(distances, at)[kept]),
            np.add, np.zeros(int(kept.sum()), dtype=np.intp))
        return system.least_squares(x)

    x, kept = np.append(shape.start, 0.0), np.ones(len(obs.station), dtype=bool)
    for _ in range(ROUNDS):
        x = fitted(x, kept)
        away = np.abs(distances(x))
        kept = away <= OUTLIER * 1.4826 * np.median(away)
    stamps = np.array([sample.stamp for sample in samples])[obs.station[kept]]
    std = _grouped_std(distances(x)[kept], derivatives(distances, x)[kept], stamps // TOGETHER)
    foreign = np.zeros(len(samples), dtype=bool)
    foreign[obs.station[away > FOREIGN * 1.4826 * np.median(away)]] = True
    return float(x[-1]), std, foreign


def compared(now: TimeOffset, before: TimeOffset) -> tuple[bool, str]:
    """Return whether a time offset has changed, and by how much in words."""
    change, std = now.value - before.value, math.hypot(now.std, before.std)
    by = f'{change * 1e3:+.2f} ms (1 sigma {std * 1e3:.2f})'
    if abs(change) <= max(SURE * std, SMALLEST):
        return False, f'the time offset is as it was: {by}'
    return True, (f'the time offset has changed by {by}: the clock or the delay of sensor or '
                  f'robot is another; set time_offset to {now.value:.5f}, or calibrate again')


def _grouped_std(r: Array, J: Array, group: Array) -> float:
    """Return 1 sigma of the last unknown, of residuals (m,) that groups (m,) of them share."""
    others, last = J[:, :-1], J[:, -1]
    own = last - others @ np.linalg.lstsq(others, last, rcond=None)[0]
    _, number = np.unique(group, return_inverse=True)
    scores = np.bincount(number, own * r)
    freedom = max(len(scores) - J.shape[1], 1)
    return float(np.sqrt((scores ** 2).sum() * len(scores) / freedom) / (own @ own))
