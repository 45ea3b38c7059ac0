"""The robot on its way: stamps, poses between the stops, and a sweep that does not stop."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array, TimedPose
from handeye_ros.simulate import arm
from handeye_ros.simulate import cell as cells
from handeye_ros.simulate.scenario import Scenario, Sweep
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

START = 1_700_000_000_000_000_000
STAMP = np.int64


@dataclass(frozen=True)
class Timeline:
    """A stop of dwell at each of n stations, and a motion between each two; seconds."""

    stations: int
    dwell: float
    move: float

    @property
    def duration(self) -> float:
        """From the arrival at the first station to the departure from the last."""
        return self.stations * self.dwell + (self.stations - 1) * self.move

    def spans(self) -> NDArray[STAMP]:
        """Return (n, 2) stamps of standing still."""
        starts = np.arange(self.stations) * (self.dwell + self.move)
        return stamps(np.stack([starts, starts + self.dwell], axis=1))

    def place(self, times: Array) -> tuple[NDArray[STAMP], Array]:
        """Return the station (k,) last stood at, and the share (k,) of the way to the next."""
        period = self.dwell + self.move
        station = np.minimum((times / period).astype(np.int64), self.stations - 1)
        s = np.clip((times - station * period - self.dwell) / self.move, 0.0, 1.0)
        s = np.where(station == self.stations - 1, 0.0, s)
        return station, s**3 * (10 - 15 * s + 6 * s**2)  # starts and stops without a jerk


def stamps(times: Array) -> NDArray[STAMP]:
    """Return integer nanoseconds of seconds since the start."""
    return START + np.round(times * 1e9).astype(np.int64)


def between(T: Array, station: NDArray[STAMP], share: Array) -> Array:
    """Return poses (k, 4, 4) at a share of the way from a station of T (n, 4, 4) to the next."""
    here, there = T[station], T[np.minimum(station + 1, len(T) - 1)]
    R = here[:, :3, :3]
    turn = se3.log_rotation(np.swapaxes(R, 1, 2) @ there[:, :3, :3])
    t = here[:, :3, 3] + share[:, None] * (there[:, :3, 3] - here[:, :3, 3])
    return se3.transform(R @ se3.exp_rotation(share[:, None] * turn), t)


INSTANTS = 5  # of one exposure that are rendered

Way = Callable[[Array], Array]
"""The poses (n, 4, 4) of the sensor in the target at times (n,)."""


def way(scenario: Scenario, T_target_sensor: Array) -> Way:
    """Return the way through sensor poses (k, 4, 4), a knot each; it rests where told."""
    sweep = _sweep(scenario)
    knots = np.arange(len(T_target_sensor)) * sweep.knot
    position = CubicSpline(knots, T_target_sensor[:, :3, 3], bc_type='natural')
    rotation = RotationSpline(knots, Rotation.from_matrix(T_target_sensor[:, :3, :3].copy()))

    def poses(times: Array) -> Array:
        at = np.clip(times, knots[0], knots[-1])
        return se3.transform(rotation(at).as_matrix(), position(at))
    return poses


def sweep_duration(scenario: Scenario) -> float:
    """Return how long a sweep takes (s)."""
    return (sum(scenario.stations) - 1) * _sweep(scenario).knot


def flange(cell: cells.Cell, T_target_sensor: Array, calibration_type: str) -> Array:
    """Return the poses (n, 4, 4) of the flange at poses of the sensor in the target."""
    T = cell.T_world_target @ T_target_sensor @ se3.inverse(cell.T_mount_sensor)
    return se3.inverse(T) if calibration_type == 'eye_on_base' else T


def swept_poses(scenario: Scenario, cell: cells.Cell, along: Way, rng: np.random.Generator
                ) -> tuple[TimedPose, ...]:
    """Return the poses that the robot streams on its way."""
    robot, sweep = scenario.robot, _sweep(scenario)
    times = np.arange(0.0, sweep_duration(scenario), 1 / robot.rate)
    times = times[~_missing(times, sweep)]
    T, late = (flange(cell, along(t), scenario.calibration_type)
               for t in (times, times - sweep.rotation_lag))
    T = se3.transform(late[:, :3, :3], T[:, :3, 3])
    T = cells.perturbed(T, cells.robot_error(robot, T, rng) + _drift(times, sweep, rng))
    stamped = np.maximum.accumulate(times + rng.normal(size=len(times)) * sweep.pose_jitter)
    if cell.arm:
        T = cells.perturbed(T, arm.reported_error(T, cell.arm))
    step = sweep.resolution
    place = np.round(T[:, :3, 3] / step) * step if step else T[:, :3, 3]
    return tuple(TimedPose(int(s), t, q) for s, t, q in zip(
        stamps(stamped), place, se3.quaternion(T), strict=True))


def _missing(times: Array, sweep: Sweep) -> NDArray[np.bool_]:
    """Return at which times (n,) no pose comes: in each of the gaps, evenly spread."""
    begins = (np.arange(sweep.gaps) + 0.5) * (times[-1] / max(sweep.gaps, 1))
    return np.asarray(((times >= begins[:, None]) & (times < begins[:, None] + sweep.gap)
                       ).any(axis=0))


def _drift(times: Array, sweep: Sweep, rng: np.random.Generator) -> Array:
    """Return an error (n, 6) of the poses that varies smoothly over time."""
    knots = np.arange(0.0, times[-1] + 2 * sweep.drift_time, sweep.drift_time)
    values = rng.normal(size=(len(knots), 6)) * np.repeat(sweep.drift, 3) / np.sqrt(3)
    return np.asarray(CubicSpline(knots, values)(times)) if any(sweep.drift) else np.zeros(
        (len(times), 6))


def exposed(scenario: Scenario, times: Array) -> Array:
    """Return the instants (n, k) that profiles of the times (n,) average over."""
    exposure = _sweep(scenario).exposure
    each = np.linspace(-0.5, 0.5, INSTANTS) * exposure if exposure else np.zeros(1)
    return np.asarray(times[:, None] + each)


def _sweep(scenario: Scenario) -> Sweep:
    assert scenario.sweep is not None
    return scenario.sweep
