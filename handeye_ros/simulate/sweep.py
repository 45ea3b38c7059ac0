"""The robot on a smooth way through all stops without stopping: the poses of a sweep."""
from __future__ import annotations

from collections.abc import Callable

from handeye_ros import se3
from handeye_ros.data import Array, TimedPose
from handeye_ros.simulate import arm, motion
from handeye_ros.simulate import cell as cells
from handeye_ros.simulate.scenario import Scenario
from handeye_ros.simulate.sweep_model import Sweep
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

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


def duration(scenario: Scenario) -> float:
    """Return how long a sweep takes (s)."""
    return (sum(scenario.stations) - 1) * _sweep(scenario).knot


def flange(cell: cells.Cell, T_target_sensor: Array, calibration_type: str) -> Array:
    """Return the poses (n, 4, 4) of the flange at poses of the sensor in the target."""
    T = cell.T_world_target @ T_target_sensor @ se3.inverse(cell.T_mount_sensor)
    return se3.inverse(T) if calibration_type == 'eye_on_base' else T


def reported(scenario: Scenario, cell: cells.Cell, along: Way, rng: np.random.Generator
             ) -> tuple[TimedPose, ...]:
    """Return the poses that the robot streams on its way."""
    robot, sweep = scenario.robot, _sweep(scenario)
    times = np.arange(0.0, duration(scenario), 1 / robot.rate)
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
        motion.stamps(stamped), place, se3.quaternion(T), strict=True))


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
