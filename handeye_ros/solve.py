"""
Least squares over the transform and the target, the same for every method.

A condition g(p) = 0 holds for a point of the sensor plane s = (x, 0, z) carried to the base,
p = R_i (X s) + a_i. Its error has two parts: the feature's own, and that of the station's
pose, which all observations of the station share. Both are whitened together.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.method import Estimate, Method, Observations
import numpy as np
from numpy.typing import NDArray

MAX_ITERATIONS = 50
LARGEST_STD = 1e3  # stands for infinity (m or rad)
SMALLEST_STD = 1e-9  # of a feature without any noise, which would weigh infinitely (m)
DISTORTION_LENGTH = 0.01  # over which the error of a sensor's field is alike (m)
FIRST_DAMPING, DAMPING_FACTOR, MAX_DAMPINGS = 1e-4, 30.0, 8
COMPETITION = ((2, 6), (3, 3), (10, 2))  # iterations, and how many starts go on after them
ROUNDING = 1e-12  # keeps a covariance invertible that one pose error rules
CONVERGED = 1e-8  # step length in sigmas
ROUNDING_OF_COST = 1e-9  # relative; whitened residuals are differences of large numbers
NEAR = 1e-6  # that of a start (m)


@dataclass(frozen=True, eq=False)
class Problem:
    """What is to be solved: T_base_flange (n, 4, 4), observations of them, and settings."""

    method: Method
    poses: Array
    observations: Observations
    config: Config

    @property
    def columns(self) -> NDArray[np.intp]:
        """Return the columns of the Jacobian that are unknown."""
        free = self.method.free(self.config)
        return np.concatenate([np.arange(6), 6 + np.flatnonzero(free)])

    def subset(self, stations: NDArray[np.intp]) -> Problem:
        """Return the problem with only the given stations (ascending indices)."""
        obs = self.observations
        keep = np.isin(obs.station, stations)
        fewer = obs.select(keep)
        renumbered = np.searchsorted(stations, fewer.station)
        return replace(self, poses=self.poses[stations],
                       observations=replace(fewer, station=renumbered))


@dataclass(frozen=True)
class Noise:
    """
    Scale factors on the configured variances.

    sensor: on the features' own; distortion: on the smooth error of the sensor's field;
    robot: on the pose noise.
    """

    sensor: float = 1.0
    distortion: float = 1.0
    robot: float = 1.0


@dataclass(frozen=True, eq=False)
class Linear:
    """Residuals (m,), their Jacobian (m, 6 + k) and what the errors do to them."""

    residuals: Array
    jacobian: Array
    by_pose: Array  # (m, 6) derivative by the pose's error, base frame, about the flange
    by_feature: Array  # (m, 2) derivative by the feature's unit errors
    by_point: Array  # (m, 2) derivative by the point of the sensor plane


@dataclass(frozen=True, eq=False)
class Whitening:
    """
    Per group of stations with equally many observations: their rows and inverse factors.

    Without groups it leaves values as they are.
    """

    rows: tuple[NDArray[np.intp], ...]
    factors: tuple[Array, ...]

    def __call__(self, values: Array) -> Array:
        """Return (m, ...) values with unit covariance."""
        white = values.copy()
        for rows, factor in zip(self.rows, self.factors, strict=True):
            flat = values[rows].reshape(*rows.shape, -1)
            white[rows] = (factor @ flat).reshape(values[rows].shape)
        return white


def points_at(observations: Observations, poses: Array, X: Array) -> Array:
    """Return the observed points (m, 3) in the base frame, of poses (n, 4, 4) and X (4, 4)."""
    in_mount = observations.points @ X[:3, [0, 2]].T + X[:3, 3]
    T = poses[observations.station]
    return np.asarray(np.einsum('mij,mj->mi', T[:, :3, :3], in_mount) + T[:, :3, 3])


def points_in_base(problem: Problem, X: Array) -> Array:
    """Return the observed points (m, 3) of a problem in the base frame."""
    return points_at(problem.observations, problem.poses, X)


def linearise(problem: Problem, estimate: Estimate) -> Linear:
    """Return residuals and derivatives at an estimate."""
    obs, X = problem.observations, estimate.X
    T = problem.poses[obs.station]
    R = T[:, :3, :3]
    lever = obs.points @ X[:3, [0, 2]].T
    from_flange = np.einsum('mij,mj->mi', R, lever + X[:3, 3])
    conditions = problem.method.conditions(from_flange + T[:, :3, 3], obs.kind, estimate.target,
                                           problem.config)
    g_base = conditions.dg_dp
    g_mount = np.einsum('mji,mj->mi', R, g_base)
    jacobian = np.hstack([g_mount, se3.cross(lever, g_mount), conditions.dg_dtarget])
    by_pose = np.hstack([g_base, se3.cross(from_flange, g_base)])
    by_point = g_mount @ X[:3, [0, 2]]
    by_feature = np.einsum('mi,mij->mj', by_point, obs.noise)
    return Linear(conditions.g, jacobian, by_pose, by_feature, by_point)


def cost(problem: Problem, estimate: Estimate) -> float:
    """Return the sum of squared plain residuals."""
    g = linearise(problem, estimate).residuals
    return float(g @ g)


def groups(station: NDArray[np.intp]) -> tuple[NDArray[np.intp], ...]:
    """Return arrays (stations, count) of rows, one for each count of rows per station."""
    _, first, count = np.unique(station, return_index=True, return_counts=True)
    return tuple(first[count == c, None] + np.arange(c) for c in np.unique(count))


def covariances(problem: Problem, linear: Linear, rows: NDArray[np.intp]) -> tuple[Array, ...]:
    """
    Return covariances, (stations, c, c), of the residuals: from features, distortion, poses.

    The distortion of a sensor is smooth: points near each other in its plane share it.
    """
    obs, noise = problem.observations, problem.config.noise
    source = obs.source[rows]
    H = linear.by_feature[rows]
    shared = source[:, :, None] == source[:, None, :]
    feature = (H @ np.swapaxes(H, 1, 2)) * shared + SMALLEST_STD ** 2 * np.eye(rows.shape[1])
    distortion = _distortion(obs.points[rows], linear.by_point[rows], noise.distortion)
    G = linear.by_pose[rows] * np.repeat([noise.robot_translation, noise.robot_rotation], 3)
    return feature, distortion, G @ np.swapaxes(G, 1, 2)


def _distortion(points: Array, by_point: Array, sigma: float) -> Array:
    """Return the covariances (n, c, c) of a smooth field at points (n, c, 2)."""
    if not sigma:
        return np.zeros((*points.shape[:2], points.shape[1]))
    apart = points[:, :, None] - points[:, None, :]
    near = np.exp(-0.5 * (apart ** 2).sum(axis=3) / DISTORTION_LENGTH ** 2)
    return np.asarray(sigma ** 2 * near * (by_point @ np.swapaxes(by_point, 1, 2)))


def whitening(problem: Problem, linear: Linear, noise: Noise) -> Whitening:
    """Return the map to residuals of unit covariance."""
    rows = groups(problem.observations.station)
    factors = []
    for group in rows:
        parts = covariances(problem, linear, group)
        scales = (noise.sensor, noise.distortion, noise.robot)
        factors.append(inverse_roots(np.tensordot(scales, np.array(parts), 1)))
    return Whitening(rows, tuple(factors))


def inverse_roots(covariance: Array) -> Array:
    """Return the whitening factors (n, c, c) of covariances (n, c, c)."""
    size = np.einsum('nii->n', covariance)[:, None, None]
    regular = covariance + ROUNDING * size * np.eye(covariance.shape[1])
    return np.asarray(np.linalg.inv(np.linalg.cholesky(regular)))


def move(problem: Problem, estimate: Estimate, step: Array) -> Estimate:
    """Return the estimate moved by a step in the unknown columns."""
    delta = np.zeros(6 + len(problem.method.labels))
    delta[problem.columns] = step
    return Estimate(se3.perturb(estimate.X, delta[:6]),
                    problem.method.retract(estimate.target, delta[6:]))


def least_squares(problem: Problem, start: Estimate, noise: Noise | None = None,
                  weights: Array | None = None, iterations: int = MAX_ITERATIONS,
                  converged: float = CONVERGED) -> Estimate:
    """
    Return the estimate with the least squared whitened residuals (Levenberg-Marquardt).

    noise: None for plain residuals, which is best far from the solution; weights: (n,) of the
    stations' squared residuals; converged: a step that changes the residuals by less ends it.
    """
    columns, station = problem.columns, problem.observations.station
    root = np.ones(len(station)) if weights is None else np.sqrt(weights)[station]
    damping, estimate, linear = FIRST_DAMPING, start, linearise(problem, start)
    for _ in range(iterations):
        white = whitening(problem, linear, noise) if noise else Whitening((), ())
        r = white(linear.residuals) * root
        J = white(linear.jacobian[:, columns]) * root[:, None]
        cost_now = float(r @ r)
        for _attempt in range(MAX_DAMPINGS):
            step = _damped_step(J, r, damping)
            moved = move(problem, estimate, step)
            moved_linear = linearise(problem, moved)
            cost_moved = ((white(moved_linear.residuals) * root) ** 2).sum()
            if cost_moved <= cost_now * (1 + ROUNDING_OF_COST):
                break
            damping *= DAMPING_FACTOR
        else:
            return estimate
        estimate, linear, damping = moved, moved_linear, max(damping / DAMPING_FACTOR**2, 1e-15)
        if np.linalg.norm(J @ step) < converged * (1.0 + np.linalg.norm(r)):
            break
    return estimate


def best_of(problem: Problem, starts: Sequence[Estimate]) -> list[Estimate]:
    """
    Return the estimates that the starts lead to, best first, poor ones given up early.

    Plain residuals decide: far from the solution they say more than whitened ones.
    """
    survivors = list(starts)
    for iterations, kept in COMPETITION:
        survivors = [least_squares(problem, start, iterations=iterations, converged=NEAR)
                     for start in survivors]
        survivors = sorted(survivors, key=lambda estimate: cost(problem, estimate))[:kept]
    return survivors


def _damped_step(J: Array, r: Array, damping: float) -> Array:
    """Return the step of Levenberg and Marquardt, its damping relative to each column."""
    scale = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    A = (J / scale).T @ (J / scale)
    step = np.linalg.solve(A + damping * np.eye(len(A)), (J / scale).T @ r)
    return np.asarray(-step / scale)


@dataclass(frozen=True, eq=False)
class Solution:
    """
    An estimate with what the data says of it.

    white: whitened residuals (m,); jacobian: whitened (m, u), u unknowns, X's six first;
    covariance: (u, u) of independent errors, infinite variances cut at LARGEST_STD; stated:
    (u, u) what is told of the uncertainty.
    """

    problem: Problem
    estimate: Estimate
    noise: Noise
    linear: Linear
    white: Array
    jacobian: Array
    covariance: Array
    stated: Array

    @property
    def variance_factor(self) -> float:
        """Return the squared whitened residual per degree of freedom."""
        return float(self.white @ self.white / max(self.degrees_of_freedom, 1))

    @property
    def degrees_of_freedom(self) -> int:
        """Return the number of conditions less the number of unknowns."""
        return len(self.white) - int(self.jacobian.shape[1])

    @property
    def target_std(self) -> Array:
        """Return 1 sigma (k,) of the target's parameters, 0 of those that were given."""
        std = np.zeros(len(self.problem.method.labels))
        std[self.problem.columns[6:] - 6] = np.sqrt(np.diag(self.stated)[6:])
        return std


def evaluate(problem: Problem, estimate: Estimate, noise: Noise) -> Solution:
    """Return the solution that an estimate is, with its covariance."""
    linear = linearise(problem, estimate)
    white = whitening(problem, linear, noise)
    r, J = white(linear.residuals), white(linear.jacobian[:, problem.columns])
    _, s, Vt = np.linalg.svd(J, full_matrices=False)
    root = Vt / np.maximum(s, 1 / LARGEST_STD)[:, None]
    covariance = root.T @ root
    return Solution(problem, estimate, noise, linear, r, J, covariance, covariance)


def station_statistic(solution: Solution) -> tuple[Array, NDArray[np.intp]]:
    """
    Return for each station its squared deleted residual and the number of its conditions.

    The deleted residual is that against the solution without the station, to first order;
    squared and whitened it is chi-squared distributed when the station is good.
    """
    obs = solution.problem.observations
    n = len(solution.problem.poses)
    chi2, count = np.zeros(n), np.bincount(obs.station, minlength=n)
    for rows in groups(obs.station):
        r, J = solution.white[rows], solution.jacobian[rows]
        H = J @ solution.covariance @ np.swapaxes(J, 1, 2)
        deleted = np.linalg.solve(np.eye(H.shape[1]) - H + 1e-9 * np.eye(H.shape[1]),
                                  r[..., None])
        chi2[obs.station[rows[:, 0]]] = np.einsum('ni,nij->n', r, deleted)
    return chi2, count


def without(solution: Solution, stations: NDArray[np.intp]) -> Estimate:
    """Return the estimate from all stations but the given ones, to first order."""
    left_out = np.isin(solution.problem.observations.station, stations)
    J, r = solution.jacobian, solution.white
    information = J[~left_out].T @ J[~left_out]
    step = np.linalg.lstsq(information, J[left_out].T @ r[left_out], rcond=1e-14)[0]
    return move(solution.problem, solution.estimate, np.asarray(step))
