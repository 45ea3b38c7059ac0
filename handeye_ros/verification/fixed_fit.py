"""
A shape fitted to what a calibrated robot measured, and what that says of the calibration.

The calibration is held fixed, as it is in use: r = d(p, q), weighted by sensor and robot, gives q.
Whitened station by station, r = J dq + G dX + n with n of unit covariance; so the error of q is
-K (G dX + n), K = pinv(J), and what is left is M (G dX + n), M = I - J K. An error dX of the
calibration enters through G: its claimed covariance C is never part of the measurement's own
uncertainty.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

from handeye_ros import se3
from handeye_ros.config import NoiseConfig, VerifyConfig
from handeye_ros.data import Array
from handeye_ros.estimation.outliers import chi2_sf
from handeye_ros.estimation.solver import White
from handeye_ros.verification.errors import BadCovarianceError
from handeye_ros.verification.shapes import (
    by_point,
    derivatives,
    groups_of,
    Seen,
    Shape,
    system_of,
)
from handeye_ros.verification.verification import K
import numpy as np
from numpy.typing import NDArray
import scipy.linalg

REFITS = 5  # of the calibration's error, which is linear by then
FARTHEST = 0.1  # m: an error beyond it is none of a calibration
LEAST_NOISE = 1e-8  # m of any distance
DRAWS = 4000  # for the distribution of an RMS
MOST_DISTANCES = 1500  # whose distribution is simulated
NOTHING_KNOWN = VerifyConfig()
LARGEST_ERROR = np.repeat([0.01, 0.1], 3)  # m, rad: 1 sigma of a calibration in use, a priori
RANK = 1e-8  # relative singular value of an unknown that the points do not show

Blocks: TypeAlias = list[tuple[NDArray[np.intp], Array]]
"""Rows of each station, and the Cholesky factor of the covariance of their distances."""


@dataclass(frozen=True, eq=False)
class FixedFit:
    """
    The fit.

    values (v,), covariance (v, v): by sensor and robot; claimed (v, v): by the calibration's
    covariance. distances (m,) that are left, distance_std (m,) of each by sensor and robot, plain;
    rms_expected: what 95 % of such RMS lie below; p: of the distances, with the calibration's
    covariance. information (6, 6): of an error of the calibration, as far as the distances, and
    the values with a nominal, show it; shift (6, 6): mean square of the displacement that it makes
    of the points. region: (v - nominal)' cov^-1 (v - nominal) by both covariances, of freedom
    values. error (6,): that of the calibration which the distances suggest, p_error: of the
    distances with it, p_no_error: of its being chance; implied: its largest displacement of a
    point (m), and implied_std. deleted (g, 3): of each group of poses its number, the squared
    deleted residual that no error of the calibration explains, and the count of its distances.
    """

    values: Array
    covariance: Array
    claimed: Array
    distances: Array
    distance_std: Array
    rms_expected: float
    p: float
    information: Array
    shift: Array
    region: float
    freedom: int
    error: Array
    p_error: float
    p_no_error: float
    implied: float
    implied_std: float
    deleted: Array


def points_in_base(seen: Seen, X: Array) -> Array:
    """Return the observed points (m, 3) of the sensor plane in the base; X: (4, 4)."""
    obs = seen.observations
    T = seen.poses[obs.station]
    in_mount = obs.points @ X[:3, [0, 2]].T + X[:3, 3]
    return np.asarray(np.einsum('mij,mj->mi', T[:, :3, :3], in_mount) + T[:, :3, 3])


def fit(seen: Seen, X: Array, C: Array, noise: NoiseConfig, shape: Shape,
        nominal: VerifyConfig = NOTHING_KNOWN) -> FixedFit:
    """
    Return the fit of a shape.

    X: (4, 4) sensor plane in the mount; C: (6, 6) its covariance; nominal: of the artefact, for
    the uncertainty of its nominal values and of how the laser was put to it.
    """
    obs, kind = seen.observations, seen.observations.kind
    p = points_in_base(seen, X)

    def whitener(q: Array) -> White:
        by_p = by_point(shape, p, kind, q)
        return partial(white, noise_factors(seen, X, by_p, noise, nominal.aim))

    system = system_of(shape, p, kind, whitener)
    q = system.least_squares(shape.start)
    by_p = by_point(shape, p, kind, q)
    blocks = noise_factors(seen, X, by_p, noise, nominal.aim)
    by_X = by_calibration(seen, X)
    G = np.einsum('mi,mij->mj', by_p, by_X)
    groups = groups_of(seen)[obs.station]
    at = system.rows(q)
    return _result(shape, q, at.residuals, at.jacobian(), G, C, blocks, by_X, groups,
                   nominal.certificate / K)


def refit(seen: Seen, X: Array, C: Array, noise: NoiseConfig, shape: Shape,
          nominal: VerifyConfig = NOTHING_KNOWN) -> tuple[FixedFit, Array]:
    """Return the fit with the calibration's error estimated too, and that error (6,)."""
    moved = X
    for _ in range(REFITS):
        found = fit(seen, moved, C, noise, shape, nominal)
        if not found.implied < FARTHEST:
            break
        moved = se3.perturb(moved, -found.error)
    return found, se3.difference(X, moved)


def _result(shape: Shape, q: Array, distances: Array, J: Array, G: Array, C: Array,
            blocks: Blocks, by_X: Array, groups: NDArray[np.intp], nominal_std: float
            ) -> FixedFit:
    white_J, white_G = white(blocks, J), white(blocks, G)
    white_r = white(blocks, distances)
    K = np.asarray(np.linalg.pinv(white_J), dtype=float)
    A = white_G - white_J @ (K @ white_G)
    rest = white_r - white_J @ (K @ white_r)
    inner, root = A.T @ A, root_of(C)
    explained = root.T @ A.T @ rest
    statistic = rest @ rest - explained @ np.linalg.solve(
        np.eye(6) + root.T @ inner @ root, explained)
    freedom = max(len(rest) - len(q), 1)
    F = derivatives(shape.values, q)
    by_error = F @ K @ white_G
    noise, claimed = F @ K @ K.T @ F.T, by_error @ C @ by_error.T
    known = np.array([k for k, n in enumerate(shape.nominals) if n is not None], dtype=int)
    noise[known, known] += nominal_std ** 2
    region = 0.0
    if len(known):
        off = shape.values(q)[known] - [shape.nominals[k] for k in known]
        region = float(off @ np.linalg.solve((noise + claimed)[np.ix_(known, known)], off))
        factor = np.linalg.cholesky(noise[np.ix_(known, known)])
        A = np.vstack([A, -np.linalg.solve(factor, by_error[known])])
        rest = np.append(rest, np.linalg.solve(factor, off))
    std = np.concatenate([np.linalg.norm(factor, axis=1) for _, factor in blocks])
    return FixedFit(shape.values(q), noise, claimed, distances, std,
                    _expected_rms(J, K, A[:len(J)], root, blocks),
                    float(chi2_sf(statistic, freedom)), A.T @ A,
                    np.einsum('mik,mil->kl', by_X, by_X) / len(J), region, len(known),
                    *_implied(A, rest, by_X, freedom + len(known)),
                    _deleted(np.hstack([white_J, white_G]), white_r, groups))


def _implied(A: Array, rest: Array, by_X: Array, freedom: int
             ) -> tuple[Array, float, float, float, float]:
    """Return the likeliest error (6,), p with it, p without it, what it moves at most, its std."""
    inverse = np.linalg.inv(A.T @ A + np.diag(LARGEST_ERROR ** -2.0))
    error = np.asarray(inverse @ A.T @ rest, dtype=float)
    left, fewer = rest - A @ error, max(freedom - 6, 1)
    scale = max(float(left @ left) / fewer, 1.0)
    moved = np.linalg.norm(by_X @ error, axis=1)
    by_noise = np.einsum('mik,kl,mil->m', by_X, inverse, by_X, optimize=True)
    worst = int(np.argmax(moved))
    explained = float(rest @ rest - left @ left) / scale
    return (error, float(chi2_sf(left @ left, fewer)), float(chi2_sf(explained, 6)),
            float(moved[worst]), float(np.sqrt(scale * by_noise[worst])))


def _deleted(columns: Array, r: Array, groups: NDArray[np.intp]) -> Array:
    """Return FixedFit.deleted: columns (m, u) of all unknowns, those of the calibration too."""
    if len(r) > MOST_DISTANCES:
        return np.empty((0, 3))
    size = np.linalg.norm(columns, axis=0)
    U, s, _ = np.linalg.svd(columns / np.where(size > 0, size, 1.0), full_matrices=False)
    U = U[:, s > RANK * s[0]]
    rest = r - U @ (U.T @ r)
    found = []
    for group in np.unique(groups):
        rows = np.flatnonzero(groups == group)
        S = np.eye(len(rows)) - U[rows] @ U[rows].T
        value, vectors = np.linalg.eigh(S)
        part = (vectors.T @ rest[rows])[value > RANK]
        found.append((group, part @ (part / value[value > RANK]), (value > RANK).sum()))
    return np.array(found, dtype=float)


def root_of(C: Array) -> Array:
    """Return R (n, n) with R R' = C, which may be singular; raises BadCovarianceError."""
    value, vectors = np.linalg.eigh((C + C.T) / 2)
    if value[0] < -1e-9 * value[-1]:
        raise BadCovarianceError
    return np.asarray(vectors * np.sqrt(np.maximum(value, 0.0)))


def _expected_rms(J: Array, K: Array, A: Array, root: Array, blocks: Blocks) -> float:
    """Return what 95 % of the RMS distances lie below; nan of very many."""
    if len(J) > MOST_DISTANCES:
        return float('nan')
    rng = np.random.default_rng(0)
    n = rng.normal(size=(len(J), DRAWS))
    white_J = white(blocks, J)
    drawn = n - white_J @ (K @ n) + A @ (root @ rng.normal(size=(6, DRAWS)))
    plain = np.empty_like(drawn)
    for rows, factor in blocks:
        plain[rows] = factor @ drawn[rows]
    return float(np.quantile(np.sqrt((plain ** 2).mean(axis=0)), 0.95))


def noise_factors(seen: Seen, X: Array, by_p: Array, noise: NoiseConfig, aim: float = 0.0
                  ) -> Blocks:
    """Return rows and Cholesky factor of the covariance of the distances of each group."""
    obs = seen.observations
    R = seen.poses[obs.station, :3, :3]
    in_plane = np.einsum('mi,mij,jk->mk', by_p, R, X[:3, [0, 2]])
    by_feature = np.einsum('mi,mij->mj', in_plane, obs.noise)
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


def white(blocks: Blocks, values: Array) -> Array:
    """Return values (m, ...) with unit covariance."""
    found = np.empty_like(values)
    for rows, factor in blocks:
        found[rows] = scipy.linalg.solve_triangular(factor, values[rows], lower=True)
    return found


def by_calibration(seen: Seen, X: Array) -> Array:
    """Return the derivatives (m, 3, 6) of the points in the base by the calibration's error."""
    obs = seen.observations
    R = seen.poses[obs.station, :3, :3]
    lever = obs.points @ X[:3, [0, 2]].T
    return np.concatenate([R, -R @ se3.skew(lever)], axis=2)
