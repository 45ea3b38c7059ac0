"""The plane: stops over the middle of a large plate, so that no edge is in sight."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.data import Array, FaceLine, Feature
from handeye_ros.simulate.scenario import PlateTarget, Scenario
from handeye_ros.simulate.stations import lift, Stops, strata, tilts
import numpy as np

FACING = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])


def stops(scenario: Scenario, rng: np.random.Generator) -> Stops:
    """Draw stops that look at points in the middle third of the plate."""
    target, n = scenario.target, sum(scenario.stations)
    assert isinstance(target, PlateTarget)
    near, far = scenario.sensor.range
    depth, width = far - near, 0.3 * scenario.sensor.half_width * near
    low = np.array([1 / 3, 1 / 3, -width, near + 0.3 * depth])
    high = np.array([2 / 3, 2 / 3, width, far - 0.3 * depth])
    place = strata(rng, n, low, high)
    R = FACING @ tilts(scenario, rng, (n,))
    spots = np.column_stack([place[:, :2] * target.size, np.zeros(n)])
    points = place[:, 2:]
    T = se3.transform(R, spots - (R @ lift(points)[:, :, None])[:, :, 0])
    return Stops(T, ('plane',) * n, points)


def features(scenario: Scenario, at: Stops,
             rng: np.random.Generator) -> list[tuple[Feature, ...]]:
    """Return the FaceLine of each stop, with the noise of all its profiles."""
    return [(_face_line(scenario, T, point, rng),)
            for T, point in zip(at.T_target_sensor, at.points, strict=True)]


def _face_line(scenario: Scenario, T: Array, point: Array, rng: np.random.Generator) -> FaceLine:
    """Return the line through what is in the field of view, as if it were sampled evenly."""
    sensor = scenario.sensor
    normal = T[2, [0, 2]] * np.sign(T[2, 2]) / np.linalg.norm(T[2, [0, 2]])
    along, distance = np.array([normal[1], -normal[0]]), normal @ point
    limits = np.array([-sensor.half_width, sensor.half_width])
    if abs(normal[0]) > 1e-9:  # the fan's angles at which the range ends
        by_range = (distance / np.array(sensor.range) - normal[1]) / normal[0]
        limits = np.clip(np.sort(by_range), *limits)
    z = distance / (limits * normal[0] + normal[1])
    first, last = np.column_stack([limits * z, z])
    spread = float((last - first) @ along) / np.sqrt(12)
    columns = (limits[1] - limits[0]) / (2 * sensor.half_width) * sensor.columns
    std = sensor.noise * along[0] / np.sqrt(columns * scenario.profiles_per_stop)
    shift, turn = rng.normal(size=2) * std
    direction = along + turn / spread * normal
    return FaceLine((first + last) / 2 + shift * normal, direction / np.linalg.norm(direction),
                    spread, float(std))
