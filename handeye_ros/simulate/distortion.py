"""What is wrong with a sensor's own calibration: a smooth error over its field of view."""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.simulate.scenario import SensorModel
import numpy as np

GRID = 21  # points along each side of the field


@dataclass(frozen=True, eq=False)
class Distortion:
    """Errors of the range: weights (16,) of polynomials of third order; and affine ones."""

    sensor: SensorModel
    weights: Array

    def ranges(self, z: Array) -> Array:
        """Return how much too long (m, n) ranges are reported, one row for each profile."""
        near, far = self.sensor.range
        x = np.linspace(-1, 1, z.shape[1])
        depth = (z - (near + far) / 2) / ((far - near) / 2)
        terms = [a * b for a in legendre(x) for b in legendre(depth)]
        return np.asarray(sum(w * term for w, term in zip(self.weights, terms, strict=True)))

    def points(self, points: Array) -> Array:
        """Return (..., 2) of the standard sensor plane stretched and sheared."""
        middle = np.array([0.0, sum(self.sensor.range) / 2])
        off = points - middle
        stretched = off * (1 + self.sensor.scale)
        stretched[..., 0] += self.sensor.shear * off[..., 1]
        return np.asarray(stretched + middle)

    @property
    def T_true_reported(self) -> Array:
        """Return the motion (4, 4) that serves reported points of the field best."""
        z = np.linspace(*self.sensor.range, GRID)[:, None]
        across = np.linspace(-1, 1, GRID) * self.sensor.half_width
        true = np.stack([across * z, np.broadcast_to(z, (GRID, GRID))], axis=-1)
        bent = z + self.ranges(np.broadcast_to(z, (GRID, GRID)))
        x = true[..., 0] if self.sensor.sampling != 'fan' else across * bent
        error = (self.points(np.stack([x, bent], axis=-1)) - true).reshape(-1, 2)
        x, z = true.reshape(-1, 2).T
        one, none = np.ones(len(x)), np.zeros(len(x))
        A = np.concatenate([np.column_stack([one, none, z]), np.column_stack([none, one, -x])])
        shift_x, shift_z, turn = np.linalg.lstsq(A, -error.T.ravel(), rcond=None)[0]
        return se3.perturb(np.eye(4), np.array([shift_x, 0, shift_z, 0, turn, 0]))


def draw(sensor: SensorModel, rng: np.random.Generator) -> Distortion | None:
    """Return the distortion of a sensor, None for one that has none."""
    if not (sensor.distortion or sensor.scale or sensor.shear):
        return None
    weights = np.zeros(16)
    if sensor.distortion:
        weights = rng.normal(size=16)
        weights *= sensor.distortion / np.linalg.norm(weights)
    return Distortion(sensor, weights)


def legendre(x: Array) -> tuple[Array, ...]:
    """Return the polynomials up to the third order, each of RMS 1 over -1 to 1."""
    return tuple(np.sqrt(2 * k + 1) * np.polynomial.legendre.Legendre.basis(k)(x)
                 for k in range(4))
