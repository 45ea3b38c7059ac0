"""The profiler: light cast on the scene, and what the camera makes of it."""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.simulate.scenario import SensorModel
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


def render(sensor: SensorModel, solids: tuple[Solid, ...], T: Array) -> tuple[Array, Array]:
    """
    Return exact ranges and angles of incidence (m, n) of the columns, NaN without a return.

    T: (m, 4, 4) T_target_sensor; the solids are in the target frame.
    """
    parts = [_render(sensor, solids, T[k:k + CHUNK]) for k in range(0, len(T), CHUNK)]
    ranges, angles = zip(*parts, strict=True)
    return np.concatenate(ranges), np.concatenate(angles)


def _render(sensor: SensorModel, solids: tuple[Solid, ...], T: Array) -> tuple[Array, Array]:
    origin, direction = columns(sensor)
    place = T[:, :3, 3].T[:, :, None]
    o = np.einsum('mij,jn->imn', T[:, :3, :3], origin) + place
    d = np.einsum('mij,jn->imn', T[:, :3, :3], direction)
    z, cosine = cast(solids, o, d)
    angle = np.arccos(np.clip(cosine, 0, 1))
    near, far = sensor.range
    x = origin[0] + direction[0] * np.where(np.isfinite(z), z, 0)
    seen = (z > near) & (z < far) & (np.abs(x) <= sensor.half_width * z * (1 + 1e-12))
    seen &= angle < sensor.max_incidence
    eye = T[:, :3, :3] @ [0.0, *sensor.camera] + T[:, :3, 3]
    points = o + d * np.where(seen, z, near)
    seen &= ~hidden(solids, points, eye.T[:, :, None])
    return np.where(seen, z, np.nan), np.where(seen, angle, np.nan)


def measure(sensor: SensorModel, z: Array, angle: Array, rng: np.random.Generator) -> Array:
    """Return ranges (m, n) as the sensor reports them, from exact ones and their incidence."""
    rim = (angle / sensor.max_incidence)**8
    noise = sensor.noise * (1 + 4 * rim) * rng.normal(size=z.shape)
    exact = z + _distortion(sensor, z, rng) if sensor.distortion else z
    measured = _mixed(sensor, z, exact + noise + sensor.rim_bias * rim**4, rng)
    measured = _lost(sensor, z, measured, rng)
    measured = _outliers(sensor, measured, rng)
    return _reflections(sensor, measured, rng)


def _distortion(sensor: SensorModel, z: Array, rng: np.random.Generator) -> Array:
    """Return the error (m, n) of the sensor's own calibration: of third order over the field."""
    near, far = sensor.range
    x = np.linspace(-1, 1, z.shape[1])
    depth = (z - (near + far) / 2) / ((far - near) / 2)
    terms = [a * b for a in legendre(x) for b in legendre(depth)]
    weights = rng.normal(size=len(terms))
    weights *= sensor.distortion / np.linalg.norm(weights)
    return np.asarray(sum(w * term for w, term in zip(weights, terms, strict=True)))


def legendre(x: Array) -> tuple[Array, ...]:
    """Return the polynomials up to the third order, each of RMS 1 over -1 to 1."""
    return tuple(np.sqrt(2 * k + 1) * np.polynomial.legendre.Legendre.basis(k)(x)
                 for k in range(4))


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


def plane_points(sensor: SensorModel, ranges: Array) -> Array:
    """Return points (m, n, 2) of the standard sensor plane for ranges (m, n)."""
    origin, direction = columns(sensor)
    points = np.stack([origin[0] + direction[0] * ranges, ranges], axis=-1)
    if sensor.resolution:
        points = np.round(points / sensor.resolution) * sensor.resolution
    return points
