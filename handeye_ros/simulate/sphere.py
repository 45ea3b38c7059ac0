"""The sphere: stops around it, its arcs, its solids."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.data import Arc, Array, Feature
from handeye_ros.simulate.scenario import Scenario, SensorModel, SphereTarget
from handeye_ros.simulate.solids import Ball, Box, Solid, table
from handeye_ros.simulate.stations import fan, Stops, strata, tilts
import numpy as np

SHARES = 12


def stops(scenario: Scenario, rng: np.random.Generator) -> Stops:
    """Draw stops whose laser plane cuts the ball within 0.6 radii of its centre."""
    target, n = scenario.target, sum(scenario.stations)
    assert isinstance(target, SphereTarget)
    radius, (near, far) = target.radius, scenario.sensor.range
    margin = 0.45 * scenario.sensor.half_width * near
    low = np.array([-margin, -0.6 * radius, near + 0.12 * (far - near)])
    high = np.array([margin, 0.6 * radius, near + 0.45 * (far - near)])
    centre = strata(rng, n, low, high)  # of the ball in the sensor frame; z: top of the arc
    centre[:, 2] += np.sqrt(radius**2 - centre[:, 1]**2)
    R = np.diag([1.0, -1.0, -1.0]) @ tilts(scenario, rng, (n,))
    T = se3.transform(R, -(R @ centre[:, :, None])[:, :, 0])
    return Stops(T, ('sphere',) * n, centre[:, [0, 2]])


def features(
        scenario: Scenario, at: Stops,
        rng: np.random.Generator) -> list[tuple[Feature, ...]]:
    """Return the Arc of each stop: points between the rims and within the field of view."""
    assert isinstance(scenario.target, SphereTarget)
    y = (at.T_target_sensor[:, :3, 1] * at.T_target_sensor[:, :3, 3]).sum(axis=1)
    radii = np.sqrt(scenario.target.radius**2 - y**2)
    return [(_arc(scenario, centre, float(radius), rng),)
            for centre, radius in zip(at.points, radii, strict=True)]


def _arc(scenario: Scenario, centre: Array, radius: float, rng: np.random.Generator) -> Arc:
    """Return an arc; its normal points lie on the circle but for their stated noise."""
    sensor = scenario.sensor
    sine = _visible(sensor, centre, radius)
    shares = [sine[k:k + len(sine) // SHARES] for k in
              range(0, len(sine) - len(sine) // SHARES + 1, len(sine) // SHARES)]
    middle = np.array([share.mean() for share in shares])
    size = np.array([len(share) for share in shares])
    std = sensor.noise * np.sqrt((1 - middle**2) / (size * scenario.profiles_per_stop))
    points = _on_circle(centre, radius, middle, rng.normal(size=len(std)) * std)
    noise = rng.normal(size=len(sine)) * sensor.noise * np.sqrt(1 - sine**2)
    return Arc(points, std, centre, radius, _on_circle(centre, radius, sine, noise))


def _on_circle(centre: Array, radius: float, sine: Array, outwards: Array) -> Array:
    normals = np.stack([sine, -np.sqrt(1 - sine**2)], axis=1)
    return np.asarray(centre + (radius + outwards)[:, None] * normals)


def _visible(sensor: SensorModel, centre: Array, radius: float) -> Array:
    """Return the sines of the normals' angles to the range axis, of the columns on the ball."""
    rim = np.sin(sensor.max_incidence)
    pitch = 2 * sensor.half_width * (centre[1] - radius) / sensor.columns
    sine = np.arange(-rim, rim, pitch / radius)
    points = _on_circle(centre, radius, sine, np.zeros(len(sine)))
    return sine[(np.abs(fan(points)) < sensor.half_width) & (points[:, 1] < sensor.range[1])]


def solids(scenario: Scenario) -> tuple[Solid, ...]:
    """Return ball, stem, table and, with clutter, a block beside the ball."""
    target = scenario.target
    assert isinstance(target, SphereTarget)
    half, bottom = target.stem / 2, -(target.table or 0.2)
    beside = 1.2 * target.radius
    ball = (Ball(target.radius), Box((-half, -half, bottom), (half, half, 0)))
    block = Box((beside, -target.radius, bottom), (beside + 0.03, target.radius, -0.015))
    return (table(target.table) + ball * (not scenario.empty)
            + (block,) * (target.clutter and not scenario.empty))
