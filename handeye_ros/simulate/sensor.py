"""The profiler: light cast on the scene, and what the camera makes of it."""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.simulate.distortion import Distortion
from handeye_ros.simulate.optics import smoothed
from handeye_ros.simulate.scenario import SensorModel
from handeye_ros.simulate.slab import Relief
from handeye_ros.simulate.solids import cast, hidden, Solid
import numpy as np

CHUNK = 32  # profiles cast at once, so that the arrays stay in the cache
EDGE_COLUMNS = 3


def columns(sensor: SensorModel) -> tuple[Array, Array]:
    """Return origins and directions (3, n) of the columns' rays; their parameter is the range."""
    zero, one = np.zeros(sensor.columns), np.ones(sensor.columns)
    across = np.linspace(-1, 1, sensor.columns) * sensor.half_width
    if sensor.sampling == 'fan':
        return np.stack([zero, zero, zero]), np.stack([across, zero, one])
    return np.stack([across * sensor.range[1], zero, zero]), np.stack([zero, zero, one])


def render(sensor: SensorModel, solids: tuple[Solid, ...], T: Array,
           relief: Relief | None = None) -> tuple[Array, Array]:
    """
    Return exact ranges and angles of incidence (m, n) of the columns, NaN without a return.

    T: (m, 4, 4) T_target_sensor; the solids are in the target frame. relief: by how much they
    are raised where a ray meets z = 0, None: not at all.
    """
    parts = [_render(sensor, solids, T[k:k + CHUNK], relief) for k in range(0, len(T), CHUNK)]
    ranges, angles = zip(*parts, strict=True)
    return np.concatenate(ranges), np.concatenate(angles)


def _render(sensor: SensorModel, solids: tuple[Solid, ...], T: Array, relief: Relief | None
            ) -> tuple[Array, Array]:
    origin, direction = columns(sensor)
    place = T[:, :3, 3].T[:, :, None]
    o = np.einsum('mij,jn->imn', T[:, :3, :3], origin) + place
    d = np.einsum('mij,jn->imn', T[:, :3, :3], direction)
    raised = _raised(relief, o, d) if relief else 0.0
    o[2] -= raised  # as if it were the solids that are raised, for each ray apart
    z, cosine = cast(solids, o, d)
    angle = np.arccos(np.clip(cosine, 0, 1))
    near, far = sensor.range
    x = origin[0] + direction[0] * np.where(np.isfinite(z), z, 0)
    seen = (z > near) & (z < far) & (np.abs(x) <= sensor.half_width * z * (1 + 1e-12))
    seen &= angle < sensor.max_incidence
    eye = T[:, :3, :3] @ [0.0, *sensor.camera] + T[:, :3, 3]
    points = o + d * np.where(seen, z, near)
    for light in (eye, T[:, :3, 3]) if sensor.sampling == 'fan_x' else (eye,):
        place = light.T[:, :, None] - np.array([0.0, 0.0, 1.0])[:, None, None] * raised
        seen &= ~hidden(solids, points, place)
    return np.where(seen, z, np.nan), np.where(seen, angle, np.nan)


def _raised(relief: Relief, o: Array, d: Array) -> Array:
    """Return the height (m, n) of the relief where rays (3, m, n) meet z = 0."""
    at = -o[2] / np.where(np.abs(d[2]) > 1e-6, d[2], 1e-6)
    return relief.heights(o[0] + at * d[0], o[1] + at * d[1])


def measure(sensor: SensorModel, z: Array, angle: Array, rng: np.random.Generator,
            distortion: Distortion | None = None) -> Array:
    """Return ranges (m, n) as the sensor reports them, from exact ones and their incidence."""
    rim = (angle / sensor.max_incidence)**8
    noise = sensor.noise * (1 + 4 * rim) * rng.normal(size=z.shape)
    exact = z + distortion.ranges(z) if distortion else z
    measured = _mixed(sensor, z, exact + noise + sensor.rim_bias * rim**4, rng)
    measured = _lost(sensor, z, measured, rng)
    measured = _outliers(sensor, measured, rng)
    return smoothed(sensor, _reflections(sensor, measured, rng))


def steps(sensor: SensorModel, z: Array) -> Array:
    """Return (m, n - 1), true where the range jumps or the light ends between two columns."""
    pitch = 2 * sensor.half_width * sensor.range[1] / sensor.columns
    jump = np.abs(np.diff(z, axis=1)) > max(3e-4, 6 * pitch)
    seen = np.isfinite(z)
    return np.asarray(jump | (seen[:, 1:] != seen[:, :-1]))


def _mixed(sensor: SensorModel, z: Array, measured: Array, rng: np.random.Generator) -> Array:
    """Put a point at some of the steps anywhere between the two levels."""
    row, left = np.nonzero(steps(sensor, z))
    at = left + rng.integers(0, 2, len(left))
    share = rng.random(len(left))
    level = measured[row, left] * share + measured[row, left + 1] * (1 - share)
    use = np.isfinite(level) & (rng.random(len(left)) < sensor.mixed)
    measured[row[use], at[use]] = level[use]
    return measured


def _lost(sensor: SensorModel, z: Array, measured: Array, rng: np.random.Generator) -> Array:
    row, left = np.nonzero(steps(sensor, z))
    chance = np.full(z.shape, sensor.lost)
    for shift in range(1 - EDGE_COLUMNS, EDGE_COLUMNS + 1):
        chance[row, np.clip(left + shift, 0, z.shape[1] - 1)] = sensor.lost_at_edge
    return np.where(rng.random(z.shape) < chance, np.nan, measured)


def _outliers(sensor: SensorModel, measured: Array, rng: np.random.Generator) -> Array:
    """Throw some points off by up to 5 mm, and show some where there is nothing."""
    chance = np.where(np.isfinite(measured), sensor.outliers, sensor.outliers / 5)
    row, at = np.nonzero(rng.random(measured.shape) < chance)
    wrong = measured[row, at] + rng.uniform(-5e-3, 5e-3, len(row))
    anywhere = rng.uniform(*sensor.range, len(row))
    measured[row, at] = np.clip(np.where(np.isfinite(wrong), wrong, anywhere), *sensor.range)
    return measured


def _reflections(sensor: SensorModel, measured: Array, rng: np.random.Generator) -> Array:
    """Show a short piece of some profiles 3-8 mm too near."""
    width = max(3, sensor.columns // 40)
    for row in np.nonzero(rng.random(len(measured)) < sensor.reflections)[0]:
        start = rng.integers(0, sensor.columns - width)
        ghost = measured[row, start:start + width] - rng.uniform(3e-3, 8e-3)
        measured[row, start:start + width] = np.maximum(ghost, sensor.range[0])
    return measured


def plane_points(sensor: SensorModel, ranges: Array, distortion: Distortion | None = None
                 ) -> Array:
    """Return points (m, n, 2) of the standard sensor plane for ranges (m, n)."""
    origin, direction = columns(sensor)
    points = np.stack([origin[0] + direction[0] * ranges, ranges], axis=-1)
    if distortion:
        points = distortion.points(points)
    if sensor.resolution:
        points = np.round(points / sensor.resolution) * sensor.resolution
    return points
