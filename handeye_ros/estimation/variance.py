"""
How noisy sensor and robot really were, from the residuals.

Two variance components are estimated by restricted maximum likelihood (Patterson and Thompson
1971, Biometrika 58:545), as multiplicative fixed-point steps. The configured noise is kept
while the residuals do not contradict it: an estimate from few stations is itself uncertain.
The distortion of the sensor's field is taken as configured: what all stations share, their
residuals hide.
"""
from __future__ import annotations

from dataclasses import astuple, dataclass

from handeye_ros.data import Array
from handeye_ros.estimation.solve import evaluate, least_squares, Solution
from handeye_ros.estimation.weights import covariances, groups, inverse_roots, Noise
import numpy as np

CONTRADICTION = 3.0  # sigmas
STEPS = 30
SMALLEST, LARGEST = 1e-4, 1e8
ESTIMATED = slice(None, None, 2)  # sensor and robot; a distortion is the same in all stations


@dataclass(frozen=True)
class _Component:
    """Of one variance component: the quadratic form, its expectation, its variance."""

    form: float
    expected: float
    variance: float

    @property
    def contradicts(self) -> bool:
        if self.variance <= 0:
            return False
        return bool(abs(self.form - self.expected) > CONTRADICTION * self.variance ** 0.5)


def with_estimated_noise(solution: Solution) -> Solution:
    """Return the solution with the noise of sensor and robot that its residuals show."""
    if not any(c.contradicts for c in _components(solution)[ESTIMATED]):
        return solution
    for _ in range(STEPS):
        before = _scales(solution.noise)
        solution = _updated(solution)
        if np.abs(np.log(_scales(solution.noise) / before)).max() < 1e-3:
            break
    return solution


def _scales(noise: Noise) -> Array:
    return np.array(astuple(noise))


def _updated(solution: Solution) -> Solution:
    """Return the solution after one step of the scale factors."""
    components = _components(solution)
    factors = [c.form / c.expected if c.expected > 0 else 1.0 for c in components]
    scales = _scales(solution.noise)
    scales[ESTIMATED] = np.clip((scales * factors)[ESTIMATED], SMALLEST, LARGEST)
    noise = Noise(*map(float, scales))
    estimate = least_squares(solution.problem, solution.estimate, noise, iterations=5)
    return evaluate(solution.problem, estimate, noise)


def _components(solution: Solution) -> list[_Component]:
    """Return the variance components, each scaled with its present factor."""
    J, covariance = solution.jacobian, solution.covariance
    scales = _scales(solution.noise)
    sums = np.zeros((len(scales), 3))
    for rows in groups(solution.problem.observations.station):
        parts = covariances(solution.problem, solution.linear, rows)
        V = [scale * part for scale, part in zip(scales, parts, strict=True)]
        inverse_root = inverse_roots(np.array(V).sum(axis=0))
        r, J_rows = solution.white[rows], J[rows]
        for k, part in enumerate(V):
            white = inverse_root @ part @ np.swapaxes(inverse_root, 1, 2)
            trace = np.einsum('nii->n', white).sum()
            fitted = np.einsum('nia,nij,njb,ab->', J_rows, white, J_rows, covariance,
                               optimize=True)
            sums[k] += [np.einsum('ni,nij,nj->', r, white, r), trace - fitted,
                        2 * np.einsum('nij,nji->', white, white)]
    return [_Component(*map(float, row)) for row in sums]
