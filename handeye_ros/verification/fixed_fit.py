# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Fits a shape to measured points, and estimates the calibration error from the deviations.

The calibration is fixed, as it is in use. The parameters q of the shape minimise the distances
r = d(p, q), weighted by the noise of sensor and robot. Whitened station by station,
r = J dq + G dX + n, where n has unit covariance. The error of q is -pinv(J) (G dX + n), and
the residuals are M (G dX + n), M = I - J pinv(J). An error dX of the calibration enters through
G: its claimed covariance C is never part of the measurement's own uncertainty.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

from handeye_ros import se3
from handeye_ros.config import NoiseConfig, VerifyConfig
from handeye_ros.data import Array
from handeye_ros.errors import InputError
from handeye_ros.estimation.least_squares import chi2_sf, White
from handeye_ros.verification.shapes import (
    by_point,
    derivatives,
    groups_of,
    Shape,
    StationSet,
    system_of,
)
from handeye_ros.verification.verification import K
import numpy as np
from numpy.typing import NDArray
import scipy.linalg

REFITS = 5  # iterations for the calibration's error
FARTHEST = 0.1  # m: no calibration error is larger
LEAST_NOISE = 1e-8  # m: 1 sigma added to every distance
DRAWS = 4000  # for the distribution of an RMS
MOST_DISTANCES = 1500  # largest number whose distribution is simulated
NOTHING_KNOWN = VerifyConfig()
LARGEST_ERROR = np.repeat([0.01, 0.1], 3)  # m, rad: 1 sigma of a calibration in use, a priori
RANK = 1e-8  # relative singular value of an unknown that the points do not show

Blocks: TypeAlias = list[tuple[NDArray[np.intp], Array]]
"""Rows of each station, and the Cholesky factor of the covariance of their distances."""


@dataclass(frozen=True, eq=False)
class FixedFit:
    """
    Result of a fit.

    values (v,): fitted; covariance, claimed (v, v): due to sensor and robot, and due to the
    calibration. distances (m,): residuals; distance_std (m,): 1 sigma due to sensor and robot;
    rms_expected: 95 % quantile of their RMS; p: p-value of the distances with the calibration's
    covariance. information (6, 6): of the distances and of the values with a nominal, about an
    error of the calibration; shift (6, 6): quadratic form that gives the mean square displacement
    of the points. region: (v - nominal)' cov^-1 (v - nominal), cov the sum of both covariances,
    of `freedom` values. error (6,): estimated error of the calibration; p_error, p_no_error:
    p-values of the distances with and without it; implied, implied_std: its largest displacement
    of a point (m). left_out (g, 3): for each group of poses its number, the squared leave-one-out
    residual that no calibration error explains, and the number of its distances.
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
    left_out: Array


def points_in_base(stations: StationSet, X: Array) -> Array:
    """Return the observed points (m, 3) in the base; X: (4, 4)."""
    obs = stations.observations
    T = stations.poses[obs.station]
    in_mount = obs.points @ X[:3, [0, 2]].T + X[:3, 3]
    return np.asarray(np.einsum('mij,mj->mi', T[:, :3, :3], in_mount) + T[:, :3, 3])


def fit(stations: StationSet, X: Array, C: Array, noise: NoiseConfig, shape: Shape,
        nominal: VerifyConfig = NOTHING_KNOWN) -> FixedFit:
    """
    Return the fit of a shape.

    X: (4, 4) sensor plane in the mount; C: (6, 6) its covariance; nominal: the artefact, with the
    uncertainty of its nominal values and of the aim of the laser at it.
    """
    obs, kind = stations.observations, stations.observations.kind
    p = points_in_base(stations, X)

    def whitener(q: Array) -> White:
        by_p = by_point(shape, p, kind, q)
        return partial(white, noise_factors(stations, X, by_p, noise, nominal.aim))

    system = system_of(shape, p, kind, whitener)
    q = system.least_squares(shape.start)
    by_p = by_point(shape, p, kind, q)
    blocks = noise_factors(stations, X, by_p, noise, nominal.aim)
    by_X = by_calibration(stations, X)
    G = np.einsum('mi,mij->mj', by_p, by_X)
    groups = groups_of(stations)[obs.station]
    solution = system.rows(q)
    return _result(shape, q, solution.residuals, solution.jacobian(), G, C, blocks, by_X, groups,
                   nominal.certificate / K)


def refit(stations: StationSet, X: Array, C: Array, noise: NoiseConfig, shape: Shape,
          nominal: VerifyConfig = NOTHING_KNOWN) -> tuple[FixedFit, Array]:
    """Return the fit with the calibration error estimated as well, and this error (6,)."""
    corrected = X
    for _ in range(REFITS):
        result = fit(stations, corrected, C, noise, shape, nominal)
        if not result.implied < FARTHEST:
            break
        corrected = se3.perturb(corrected, -result.error)
    return result, se3.difference(X, corrected)


def _result(shape: Shape, q: Array, distances: Array, J: Array, G: Array, C: Array,
            blocks: Blocks, by_X: Array, groups: NDArray[np.intp], nominal_std: float
            ) -> FixedFit:
    white_J, white_G = white(blocks, J), white(blocks, G)
    white_r = white(blocks, distances)
    gain = np.asarray(np.linalg.pinv(white_J), dtype=float)
    A = white_G - white_J @ (gain @ white_G)
    remainder = white_r - white_J @ (gain @ white_r)
    inner, root = A.T @ A, root_of(C)
    explained = root.T @ A.T @ remainder
    statistic = remainder @ remainder - explained @ np.linalg.solve(
        np.eye(6) + root.T @ inner @ root, explained)
    freedom = max(len(remainder) - len(q), 1)
    F = derivatives(shape.values, q)
    by_error = F @ gain @ white_G
    noise, claimed = F @ gain @ gain.T @ F.T, by_error @ C @ by_error.T
    with_nominal = np.array([k for k, n in enumerate(shape.nominals) if n is not None], dtype=int)
    noise[with_nominal, with_nominal] += nominal_std ** 2
    region = 0.0
    if len(with_nominal):
        deviation = shape.values(q)[with_nominal] - [shape.nominals[k] for k in with_nominal]
        block = np.ix_(with_nominal, with_nominal)
        region = float(deviation @ np.linalg.solve((noise + claimed)[block], deviation))
        factor = np.linalg.cholesky(noise[block])
        A = np.vstack([A, -np.linalg.solve(factor, by_error[with_nominal])])
        remainder = np.append(remainder, np.linalg.solve(factor, deviation))
    std = np.concatenate([np.linalg.norm(factor, axis=1) for _, factor in blocks])
    return FixedFit(shape.values(q), noise, claimed, distances, std,
                    _expected_rms(J, gain, A[:len(J)], root, blocks),
                    float(chi2_sf(statistic, freedom)), A.T @ A,
                    np.einsum('mik,mil->kl', by_X, by_X) / len(J), region, len(with_nominal),
                    *_implied(A, remainder, by_X, freedom + len(with_nominal)),
                    _leave_one_out(np.hstack([white_J, white_G]), white_r, groups))


def _implied(A: Array, remainder: Array, by_X: Array, freedom: int
             ) -> tuple[Array, float, float, float, float]:
    """Return the most likely error (6,), p with and without it, its largest effect and std."""
    inverse = np.linalg.inv(A.T @ A + np.diag(LARGEST_ERROR ** -2.0))
    error = np.asarray(inverse @ A.T @ remainder, dtype=float)
    residuals, freedom_left = remainder - A @ error, max(freedom - 6, 1)
    scale = max(float(residuals @ residuals) / freedom_left, 1.0)
    displacements = np.linalg.norm(by_X @ error, axis=1)
    by_noise = np.einsum('mik,kl,mil->m', by_X, inverse, by_X, optimize=True)
    worst = int(np.argmax(displacements))
    explained = float(remainder @ remainder - residuals @ residuals) / scale
    return (error, float(chi2_sf(residuals @ residuals, freedom_left)),
            float(chi2_sf(explained, 6)), float(displacements[worst]),
            float(np.sqrt(scale * by_noise[worst])))


def _leave_one_out(columns: Array, r: Array, groups: NDArray[np.intp]) -> Array:
    """Return FixedFit.left_out; columns (m, u): derivatives by shape and calibration."""
    if len(r) > MOST_DISTANCES:
        return np.empty((0, 3))
    size = np.linalg.norm(columns, axis=0)
    U, s, _ = np.linalg.svd(columns / np.where(size > 0, size, 1.0), full_matrices=False)
    U = U[:, s > RANK * s[0]]
    remainder = r - U @ (U.T @ r)
    results = []
    for group in np.unique(groups):
        rows = np.flatnonzero(groups == group)
        S = np.eye(len(rows)) - U[rows] @ U[rows].T
        value, vectors = np.linalg.eigh(S)
        free = value > RANK
        projected = (vectors.T @ remainder[rows])[free]
        results.append((group, projected @ (projected / value[free]), free.sum()))
    return np.array(results, dtype=float)


def root_of(C: Array) -> Array:
    """Return R (n, n) with R R' = C, which may be singular; raises InputError."""
    value, vectors = np.linalg.eigh((C + C.T) / 2)
    if value[0] < -1e-9 * value[-1]:
        raise InputError('the covariance of the calibration has a negative variance, so it is not '
                         'valid: use the calibration.yaml as it was written')
    return np.asarray(vectors * np.sqrt(np.maximum(value, 0.0)))


def _expected_rms(J: Array, gain: Array, A: Array, root: Array, blocks: Blocks) -> float:
    """Return the 95 % quantile of the RMS distance; nan for very many points."""
    if len(J) > MOST_DISTANCES:
        return float('nan')
    rng = np.random.default_rng(0)
    n = rng.normal(size=(len(J), DRAWS))
    white_J = white(blocks, J)
    drawn = n - white_J @ (gain @ n) + A @ (root @ rng.normal(size=(6, DRAWS)))
    plain = np.empty_like(drawn)
    for rows, factor in blocks:
        plain[rows] = factor @ drawn[rows]
    return float(np.quantile(np.sqrt((plain ** 2).mean(axis=0)), 0.95))


def noise_factors(stations: StationSet, X: Array, by_p: Array, noise: NoiseConfig, aim: float = 0.0
                  ) -> Blocks:
    """Return rows and Cholesky factor of the covariance of the distances of each group."""
    obs = stations.observations
    R = stations.poses[obs.station, :3, :3]
    in_plane = np.einsum('mi,mij,jk->mk', by_p, R, X[:3, [0, 2]])
    by_feature = np.einsum('mi,mij->mj', in_plane, obs.noise)
    from_flange = np.einsum('mij,mj->mi', R, obs.points @ X[:3, [0, 2]].T + X[:3, 3])
    by_pose = np.hstack([by_p, np.cross(from_flange, by_p)])
    sigma = np.repeat([np.hypot(noise.robot_translation, aim), noise.robot_rotation], 3)
    blocks = []
    group = groups_of(stations)[obs.station]
    for rows in np.split(np.arange(len(obs)), np.flatnonzero(np.diff(group)) + 1):
        shared = obs.source[rows, None] == obs.source[rows]
        S = (by_feature[rows] @ by_feature[rows].T) * shared
        pose = by_pose[rows] * sigma
        S = S + pose @ pose.T + LEAST_NOISE ** 2 * np.eye(len(rows))
        blocks.append((rows, np.linalg.cholesky(S)))
    return blocks


def white(blocks: Blocks, values: Array) -> Array:
    """Return values (m, ...) whitened by group."""
    whitened = np.empty_like(values)
    for rows, factor in blocks:
        whitened[rows] = scipy.linalg.solve_triangular(factor, values[rows], lower=True)
    return whitened


def by_calibration(stations: StationSet, X: Array) -> Array:
    """Return the derivatives (m, 3, 6) of the points by an error of the calibration."""
    obs = stations.observations
    R = stations.poses[obs.station, :3, :3]
    lever = obs.points @ X[:3, [0, 2]].T
    return np.concatenate([R, -R @ se3.skew(lever)], axis=2)
