"""
A shape fitted to what a calibrated robot measured, and what that says of the calibration.

The calibration is held fixed, as it is in use: r = d(p, q), weighted by sensor and robot, gives q.
Whitened station by station, r = J dq + G dX + n with n of unit covariance; so the error of q is
-K (G dX + n), K = pinv(J), and what is left is M (G dX + n), M = I - J K. The calibration's own
covariance C enters through G.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from handeye_ros.config import NoiseConfig
from handeye_ros.data import Array
from handeye_ros.estimation.model import Observations
from handeye_ros.estimation.quantiles import chi2_sf
from handeye_ros.verification.routine import groups_of, Seen, Shape
import numpy as np
from numpy.typing import NDArray
import scipy.linalg

STEP = 1e-7  # of numeric derivatives (m, rad)
ITERATIONS = 25
CONVERGED = 1e-10
LEAST_NOISE = 1e-8  # m of any distance
DRAWS = 4000  # for the distribution of an RMS
MOST_DISTANCES = 1500  # whose distribution is told

Blocks: TypeAlias = list[tuple[NDArray[np.intp], Array]]
"""Rows of each station, and the Cholesky factor of the covariance of their distances."""


@dataclass(frozen=True, eq=False)
class FixedFit:
    """
    The fit.

    values (v,) with their covariance, and the part of it that the calibration makes. distances
    (m,) that are left, plain; rms_expected: what 95 % of such RMS lie below; p: the share whose
    points disagree at least as much. information (6, 6): of an error of the calibration, as far
    as the distances, and the values with a nominal, show it; shift (6, 6): mean square of the
    displacement that it makes of the points. region: (v - nominal)' cov^-1 (v - nominal), of
    freedom values. implied: largest displacement of a point by that error of the calibration
    which the distances suggest (m), and implied_noise: what noise alone makes of it; error (6,):
    that error, p_error: the p of the distances with it.
    """

    values: Array
    covariance: Array
    from_calibration: Array
    distances: Array
    rms_expected: float
    p: float
    information: Array
    shift: Array
    region: float
    freedom: int
    implied: float
    implied_noise: float
    error: Array
    p_error: float


def points_in_base(seen: Seen, X: Array) -> Array:
    """Return the observed points (m, 3) of the sensor plane in the base; X: (4, 4)."""
    obs = seen.observations
    T = seen.poses[obs.station]
    in_mount = obs.points @ X[:3, [0, 2]].T + X[:3, 3]
    return np.asarray(np.einsum('mij,mj->mi', T[:, :3, :3], in_mount) + T[:, :3, 3])


def fit(seen: Seen, X: Array, C: Array, noise: NoiseConfig, shape: Shape, aim: float = 0.0
        ) -> FixedFit:
    """
    Return the fit of a shape.

    X: (4, 4) sensor plane in the mount; C: (6, 6) its covariance; aim: 1 sigma of how exactly the
    laser was put to the artefact (m).
    """
    obs, kind = seen.observations, seen.observations.kind
    p = points_in_base(seen, X)
    normals = _by_point(shape, p, kind, shape.start)
    blocks = _factors(obs, seen, X, normals, noise, aim)
    q, J = shape.start, _by_unknowns(shape, p, kind, shape.start)
    for _ in range(ITERATIONS):
        J = _by_unknowns(shape, p, kind, q)
        step = np.linalg.lstsq(_white(blocks, J), -_white(
            blocks, shape.distance(p, kind, q)[:, None])[:, 0], rcond=None)[0]
        q = q + step
        if np.abs(step).max() < CONVERGED:
            break
    by_p = _by_point(shape, p, kind, q)
    blocks = _factors(obs, seen, X, by_p, noise, aim)
    by_X = _by_calibration(obs, seen, X)
    G = np.einsum('mi,mij->mj', by_p, by_X)
    return _told(shape, q, shape.distance(p, kind, q), J, G, C, blocks,
                 by_X)


def _told(shape: Shape, q: Array, distances: Array, J: Array, G: Array, C: Array,
          blocks: Blocks, by_X: Array) -> FixedFit:
    white_J, white_G = _white(blocks, J), _white(blocks, G)
    white_r = _white(blocks, distances[:, None])[:, 0]
    K = np.asarray(np.linalg.pinv(white_J), dtype=float)
    A = white_G - white_J @ (K @ white_G)
    rest = white_r - white_J @ (K @ white_r)
    inner = A.T @ A
    root = np.asarray(np.linalg.cholesky(C + 1e-30 * np.eye(6)), dtype=float)
    explained = root.T @ A.T @ rest
    statistic = rest @ rest - explained @ np.linalg.solve(
        np.eye(6) + root.T @ inner @ root, explained)
    freedom = max(len(rest) - len(q), 1)
    F = _numeric(lambda at: shape.values(at), q)
    by_calibration = F @ K @ white_G
    noise = F @ K @ K.T @ F.T
    part = by_calibration @ C @ by_calibration.T
    known = np.array([k for k, n in enumerate(shape.nominals) if n is not None], dtype=int)
    region = 0.0
    if len(known):
        off = shape.values(q)[known] - [shape.nominals[k] for k in known]
        both = (noise + part)[np.ix_(known, known)]
        region = float(off @ np.linalg.solve(both, off))
        own = noise[np.ix_(known, known)]
        inner = inner + by_calibration[known].T @ np.linalg.solve(own, by_calibration[known])
    return FixedFit(shape.values(q), noise + part, part, distances,
                    _expected_rms(J, K, A, root, blocks, len(q)),
                    float(chi2_sf(statistic, freedom)), inner,
                    np.einsum('mik,mil->kl', by_X, by_X) / len(J), region, len(known),
                    *_implied(A, rest, by_X, freedom))


def _implied(A: Array, rest: Array, by_X: Array, freedom: int
             ) -> tuple[float, float, Array, float]:
    """Return how far the likeliest error moves a point, the same of noise, the error, its p."""
    inverse = np.linalg.pinv(A.T @ A, rcond=1e-12, hermitian=True)
    error = np.asarray(inverse @ A.T @ rest, dtype=float)
    left, fewer = rest - A @ error, max(freedom - 6, 1)
    scale = max(float(left @ left) / fewer, 1.0)
    moved = np.linalg.norm(by_X @ error, axis=1)
    by_noise = np.einsum('mik,kl,mil->m', by_X, inverse, by_X, optimize=True)
    worst = int(np.argmax(moved))
    return (float(moved[worst]), float(np.sqrt(scale * by_noise[worst])), error,
            float(chi2_sf(left @ left, fewer)))


def _expected_rms(J: Array, K: Array, A: Array, root: Array, blocks: Blocks, unknowns: int
                  ) -> float:
    """Return what 95 % of the RMS distances lie below; nan of very many."""
    m = len(J)
    if m > MOST_DISTANCES:
        return float('nan')
    rng = np.random.default_rng(0)
    n = rng.normal(size=(m, DRAWS))
    white_J = _white(blocks, J)
    white = n - white_J @ (K @ n) + A @ (root @ rng.normal(size=(6, DRAWS)))
    plain = np.empty_like(white)
    for rows, factor in blocks:
        plain[rows] = factor @ white[rows]
    return float(np.quantile(np.sqrt((plain ** 2).mean(axis=0)), 0.95))


def _factors(obs: Observations, seen: Seen, X: Array, by_p: Array, noise: NoiseConfig,
             aim: float) -> Blocks:
    """Return rows and Cholesky factor of the covariance of the distances of each group."""
    R = seen.poses[obs.station, :3, :3]
    by_point = np.einsum('mi,mij,jk->mk', by_p, R, X[:3, [0, 2]])
    by_feature = np.einsum('mi,mij->mj', by_point, obs.noise)
    from_flange = np.einsum('mij,mj->mi', R, obs.points @ X[:3, [0, 2]].T + X[:3, 3])
    by_pose = np.hstack([by_p, np.cross(from_flange, by_p)])
    sigma = np.repeat([np.hypot(noise.robot_translation, aim), noise.robot_rotation], 3)
    blocks = []
    group = groups_of(seen)[obs.station]
    for rows in np.split(np.arange(len(obs)), np.flatnonzero(np.diff(group)) + 1):
        shared = obs.source[rows, None] == obs.source[rows]
        S = (by_feature[rows] @ by_feature[rows].T) * shared
        pose = by_pose[rows] * sigma
        S = S + pose @ pose.T + LEAST_NOISE ** 2 * np.eye(len(rows))
        blocks.append((rows, np.linalg.cholesky(S)))
    return blocks


def _white(blocks: Blocks, values: Array) -> Array:
    """Return values (m, c) with unit covariance."""
    white = np.empty_like(values)
    for rows, factor in blocks:
        white[rows] = scipy.linalg.solve_triangular(factor, values[rows], lower=True)
    return white


def _by_calibration(obs: Observations, seen: Seen, X: Array) -> Array:
    """Return the derivatives (m, 3, 6) of the points by the calibration's error."""
    R = seen.poses[obs.station, :3, :3]
    lever = obs.points @ X[:3, [0, 2]].T
    turn = np.zeros((len(obs), 3, 3))
    turn[:, 0, 1], turn[:, 0, 2], turn[:, 1, 2] = lever[:, 2], -lever[:, 1], lever[:, 0]
    turn -= np.swapaxes(turn, 1, 2)
    return np.concatenate([R, R @ turn], axis=2)


def _by_point(shape: Shape, p: Array, kind: NDArray[np.intp], q: Array) -> Array:
    return np.stack([(shape.distance(p + d, kind, q) - shape.distance(p - d, kind, q))
                     / (2 * STEP) for d in STEP * np.eye(3)], axis=1)


def _by_unknowns(shape: Shape, p: Array, kind: NDArray[np.intp], q: Array) -> Array:
    return _numeric(lambda at: shape.distance(p, kind, at), q)


def _numeric(function: Callable[[Array], Array], q: Array) -> Array:
    """Return the derivatives (m, k) of a function at q (k,)."""
    return np.stack([(function(q + d) - function(q - d)) / (2 * STEP)
                     for d in STEP * np.eye(len(q))], axis=1)
