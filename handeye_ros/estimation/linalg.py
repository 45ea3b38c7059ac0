# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Covariances of least squares, and their roots, where not all directions are determined.

In an inverse, a direction that the data do not show keeps a large, finite variance.
"""
from __future__ import annotations

from handeye_ros.data import Array
import numpy as np
from scipy.linalg import eigh, lapack

LARGEST_STD = 1e3  # of a direction without information (m or rad)
FREE = 1e-13  # relative information, or variance, that is rounding
NOTHING = 1e-280  # smallest information: its inverse is still a number


def covariance_of(J: Array) -> Array:
    """Return the covariance (u, u) of the unknowns of a whitened J (m, u), sigmas bounded."""
    few = len(J) < J.shape[1]  # then only the full SVD of J has the free directions
    _, s, Vt = np.linalg.svd(J if few else np.linalg.qr(J, mode='r'))
    values = np.pad(s, (0, len(Vt) - len(s)))
    root = Vt / np.maximum(values, 1 / LARGEST_STD)[:, None]
    return np.asarray(root.T @ root)


def inverse(information: Array) -> Array:
    """Return the inverse of a symmetric positive matrix, variances of free directions bounded."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), NOTHING))
    return _inverse_of_scaled(information * scale * scale[:, None], scale)


def _inverse_of_scaled(scaled: Array, scale: Array) -> Array:
    """Return the inverse of M (p, p), given scaled = scale * M * scale with a unit diagonal."""
    np.einsum('ii->i', scaled)[:] += FREE
    root, failed = lapack.dpotrf(scaled.T, lower=1)  # and zeros above it
    if not failed:
        lower, _ = lapack.dpotri(root, lower=1, overwrite_c=1)
        full = lower + lower.T
        np.einsum('ii->i', full)[:] /= 2
    else:
        values, vectors = eigen(scaled)
        full = (vectors / np.maximum(values, FREE)) @ vectors.T
    full *= scale
    full *= scale[:, None]
    return np.asarray(full)


def from_information(N: Array, b: Array, units: Array, priors: int) -> tuple[Array, Array]:
    """
    Return the solution -C b (p,) of normal equations, and its covariance C (p, p), as in (5).

    N (p, p), b (p,): information and gradient of whitened residuals; units: (p,) units of the
    solution, 1 for unknowns and tau for nuisance parameters; priors: number of last parameters,
    which have a prior of unit variance in these units.
    """
    diagonal = np.diag(N) * units ** 2
    diagonal[len(b) - priors:] += 1.0
    scale = 1 / np.sqrt(np.maximum(diagonal, NOTHING))
    both = units * scale
    scaled = N * both
    scaled *= both[:, None]
    np.einsum('ii->i', scaled)[:] = diagonal * scale ** 2
    covariance = _inverse_of_scaled(scaled, scale)
    return covariance @ (-units * b), covariance


def from_rows(A: Array, r: Array, priors: int) -> tuple[Array, Array]:
    """
    Return the same as from_information, from few residuals r (m,) and derivatives A (m, p).

    Inverts m x m, not p x p. Parameters with a prior first count as errors of the residuals, and
    are then estimated from these errors (as in a Kalman filter).
    """
    u = A.shape[1] - priors
    V = A[:, u:] @ A[:, u:].T
    np.einsum('ii->i', V)[:] += 1.0
    root, _ = lapack.dpotrf(V, lower=1)  # V >= 1: it cannot fail
    whitener, _ = lapack.dtrtri(root, lower=1)
    white, r = whitener @ A, whitener @ r
    J, K = white[:, :u], white[:, u:]
    covariance = np.eye(A.shape[1])
    covariance[:u, :u] = inverse(J.T @ J)
    x, gain = -covariance[:u, :u] @ (J.T @ r), J @ covariance[:u, :u]
    covariance[:u, u:] = -gain.T @ K
    covariance[u:, :u] = covariance[:u, u:].T
    covariance[u:, u:] -= K.T @ (K - gain @ (J.T @ K))
    return np.append(x, -K.T @ (r + J @ x)), covariance


def eigen(A: Array) -> tuple[Array, Array]:
    """Return the eigenvalues (n,), ascending, and eigenvectors (n, n) of a symmetric matrix."""
    try:
        values, vectors = np.linalg.eigh(A)
    except np.linalg.LinAlgError:  # divide and conquer (n > 25) with some kernels of OpenBLAS
        values, vectors = eigh(A, driver='ev')
    return values, vectors


def inverse_roots(covariance: Array) -> Array:
    """Return the whitening factors (n, c, c) of covariances (n, c, c)."""
    size = 1e-12 * np.einsum('nii->n', covariance)[:, None, None]  # many points: rank 6
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance + size * np.eye(
        covariance.shape[1]))))
