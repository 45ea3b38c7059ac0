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

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

from handeye_ros import se3
from handeye_ros.config import NoiseConfig, VerifyConfig
from handeye_ros.data import Array
from handeye_ros.errors import InputError
from handeye_ros.estimation.least_squares import chi2_isf, chi2_sf, Rows, System, White
from handeye_ros.verification.shapes import derivatives, Kinds, Shape, StationSet
import numpy as np
from numpy.typing import NDArray
import scipy.linalg

K = 2.0  # coverage factor of expanded uncertainties (GUM: about 95 %)
REFITS = 5  # iterations for the calibration's error
FARTHEST = 0.1  # m: no calibration error is larger
LEAST_NOISE = 1e-8  # m: 1 sigma added to every distance
MOST_DISTANCES = 1500  # of which each group is tested against the others
LARGEST_ERROR = np.repeat([0.01, 0.1], 3)  # m, rad: 1 sigma of a calibration in use, a priori
UNSEEN = 1e-6  # change of a value that no distance shows, per unit of an unknown
RANK = 1e-8  # relative singular value of an unknown that the points do not show

Blocks: TypeAlias = list[tuple[NDArray[np.intp], Array]]
"""Rows of each station, and the Cholesky factor of the covariance of their distances."""


@dataclass(frozen=True, eq=False)
class FixedFit:
    """
    Result of a fit.

    values (v,): fitted; covariance, claimed (v, v): due to sensor and robot, infinite for a value
    that the points leave open, and due to the calibration. distances (m,): residuals;
    distance_std (m,): 1 sigma due to sensor and robot; rms_expected: 95 % quantile of their RMS;
    p: p-value of the distances with the calibration's covariance. information (6, 6): of the
    distances and of the values with a nominal, about an error of the calibration; shift (6, 6):
    quadratic form that gives the mean square displacement of the points. region:
    (v - nominal)' cov^-1 (v - nominal), cov the sum of both covariances, of `freedom` values.
    error (6,): estimated error of the calibration; p_error, p_no_error: p-values of the distances
    with and without it; implied, implied_std: its largest displacement of a point (m). left_out
    (g, 3): for each group of poses its number, the squared leave-one-out residual that no
    calibration error explains, and the number of its distances.
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


def fit(stations: StationSet, X: Array, C: Array, noise: NoiseConfig, shape: Shape,
        nominal: VerifyConfig) -> FixedFit:
    """
    Return the fit of a shape; raises InputError for an impossible covariance.

    X: (4, 4) sensor plane in the mount; C: (6, 6) its covariance; nominal: the artefact, with the
    uncertainty of its nominal values and of the aim of the laser at it.
    """
    kind, p = stations.observations.kind, stations.points(X)

    def noise_at(q: Array) -> Blocks:
        return noise_factors(stations, X, shape.by_point(p, kind, q), noise, nominal.aim)

    q = least_squares(shape, p, kind, shape.start, lambda q: partial(white, noise_at(q)))
    blocks, by_X = noise_at(q), by_calibration(stations, X)
    distances = shape.distance(p, kind, q)
    r, J = white(blocks, distances), white(blocks, shape.by_unknowns(p, kind, q))
    G = white(blocks, np.einsum('mi,mij->mj', shape.by_point(p, kind, q), by_X))
    gain = np.asarray(np.linalg.pinv(J), dtype=float)
    A, remainder = G - J @ (gain @ G), r - J @ (gain @ r)  # what the shape does not take up

    # do the distances agree with the noise and with what the calibration claims
    root = root_of(C)
    explained = root.T @ A.T @ remainder
    statistic = remainder @ remainder - explained @ np.linalg.solve(
        np.eye(6) + root.T @ A.T @ A @ root, explained)
    freedom = max(len(r) - len(q), 1)
    p_distances = float(chi2_sf(statistic, freedom))
    expected = _expected_rms(J, gain, A @ root, blocks)

    # the measured values, and those of them that have a nominal one
    values, F = shape.values(q), derivatives(shape.values, q)
    by_error = F @ gain @ G
    covariance, claimed = F @ gain @ gain.T @ F.T, by_error @ C @ by_error.T
    open_values = np.abs(F - F @ gain @ J).max(axis=1, initial=0.0) > UNSEEN
    known = np.array([k for k, n in enumerate(shape.nominals)
                      if n is not None and not open_values[k]], dtype=int)
    covariance[known, known] += (nominal.certificate / K) ** 2
    region = 0.0
    if len(known):
        deviation = values[known] - [shape.nominals[k] for k in known]
        block = np.ix_(known, known)
        region = float(deviation @ np.linalg.solve((covariance + claimed)[block], deviation))
        factor = np.linalg.cholesky(covariance[block])
        A = np.vstack([A, -np.linalg.solve(factor, by_error[known])])
        remainder = np.append(remainder, np.linalg.solve(factor, deviation))

    covariance[open_values, open_values] = np.inf

    # the most likely error of the calibration
    inverse = np.linalg.inv(A.T @ A + np.diag(LARGEST_ERROR ** -2.0))
    error = np.asarray(inverse @ A.T @ remainder, dtype=float)
    left = float(((remainder - A @ error) ** 2).sum())
    freedom_left = max(freedom + len(known) - 6, 1)
    scale = max(left / freedom_left, 1.0)
    displacements = np.linalg.norm(by_X @ error, axis=1)
    worst = int(np.argmax(displacements))
    return FixedFit(
        values, covariance, claimed, distances,
        np.concatenate([np.linalg.norm(factor, axis=1) for _, factor in blocks]), expected,
        p_distances, A.T @ A, np.einsum('mik,mil->kl', by_X, by_X) / len(r), region, len(known),
        error, float(chi2_sf(left, freedom_left)),
        float(chi2_sf((remainder @ remainder - left) / scale, 6)), float(displacements[worst]),
        float(np.sqrt(scale * np.trace(by_X[worst] @ inverse @ by_X[worst].T))),
        _leave_one_out(np.hstack([J, G]), r, stations.row_groups))


def refit(stations: StationSet, X: Array, C: Array, noise: NoiseConfig, shape: Shape,
          nominal: VerifyConfig) -> FixedFit:
    """Return the fit with the calibration error estimated as well, for errors of any size."""
    for _ in range(REFITS):
        result = fit(stations, X, C, noise, shape, nominal)
        if not result.implied < FARTHEST:
            break
        X = se3.perturb(X, -result.error)
    return result


def least_squares(shape: Shape, p: Array, kind: Kinds, start: Array,
                  whitener: Callable[[Array], White] | None = None, iterations: int = 50) -> Array:
    """Return the unknowns (k,) of a shape that fit points p (m, 3) best, whitened if given."""
    def rows(q: Array) -> Rows:
        found = Rows(shape.distance(p, kind, q), partial(shape.by_unknowns, p, kind, q))
        return replace(found, white=lambda: whitener(q)) if whitener else found

    return System[Array](rows, np.add, np.zeros(len(p), dtype=np.intp)).least_squares(
        start, iterations=iterations)


def _expected_rms(J: Array, gain: Array, by_calibration: Array, blocks: Blocks) -> float:
    """
    Return the 95 % quantile of the RMS distance if the uncertainties are as stated.

    The sum of squares is taken as a multiple of chi-squared with the same mean and variance
    (Satterthwaite 1946). nan for very many points.
    """
    if len(J) > MOST_DISTANCES:
        return float('nan')
    spread = np.hstack([np.eye(len(J)) - J @ gain, by_calibration])
    for rows, factor in blocks:
        spread[rows] = factor @ spread[rows]
    S = spread @ spread.T
    freedom = float(np.trace(S) ** 2 / (S ** 2).sum())
    return float(np.sqrt(np.trace(S) / len(J) * chi2_isf(0.05, freedom) / freedom))


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
        value, vectors = np.linalg.eigh(np.eye(len(rows)) - U[rows] @ U[rows].T)
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
    for rows in np.split(np.arange(len(obs)), np.flatnonzero(np.diff(stations.row_groups)) + 1):
        shared = obs.source[rows, None] == obs.source[rows]
        pose = by_pose[rows] * sigma
        S = (by_feature[rows] @ by_feature[rows].T) * shared + pose @ pose.T
        blocks.append((rows, np.linalg.cholesky(S + LEAST_NOISE ** 2 * np.eye(len(rows)))))
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
