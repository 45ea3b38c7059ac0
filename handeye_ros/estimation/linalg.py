# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Covariances of least squares, and their roots, where not all directions are determined.

In an inverse, a direction that the data do not show keeps a large, finite variance.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray
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


@dataclass(frozen=True, eq=False)
class Derivatives:
    """
    Derivatives (m, p) by c parameters, and by the coefficients of a sum of functions along a axes.

    Row i changes by local[i, c + l] * functions[station[i], j] with coefficient j along axis l.
    With thousands of stations, products of these factors are many times as fast as of the dense
    matrix. local: (m, c + a); functions: (n, k) at the stations; p = c + a * k, axis by axis;
    rows: row numbers (s, count) of stations with equally many; station: (m,).
    """

    local: Array
    functions: Array
    axes: int
    rows: Sequence[NDArray[np.intp]]
    station: NDArray[np.intp]

    @cached_property
    def dense(self) -> Array:
        """Return the matrix (m, p)."""
        c = self.local.shape[1] - self.axes
        summed = self.local[:, c:, None] * self.functions[self.station][:, None]
        return np.concatenate([self.local[:, :c], summed.reshape(len(summed), -1)], axis=1)

    @cached_property
    def gram(self) -> Array:
        """Return the product (p, p) of the transposed matrix and the matrix."""
        a, k = self.axes, self.functions.shape[1]
        c, own = self.local.shape[1] - a, self.local[:, :-a or None]
        N = np.zeros((c + a * k, c + a * k))
        N[:c, :c] = own.T @ own
        for rows in self.rows:
            local, f = self.local[rows], self.functions[self.station[rows[:, 0]]]
            by_axes = np.swapaxes(local, 1, 2) @ local[..., c:]
            N[:c, c:] += (by_axes[:, :c].reshape(len(f), c * a).T @ f).reshape(c, a * k)
            pairs = (f[:, :, None] * f[:, None]).reshape(len(f), k * k)
            both = (by_axes[:, c:].reshape(len(f), a * a).T @ pairs).reshape(a, a, k, k)
            N[c:, c:] += both.swapaxes(1, 2).reshape(a * k, a * k)
        N[c:, :c] = N[:c, c:].T
        return N

    def gradient(self, r: Array) -> Array:
        """Return the product (p,) of the transposed matrix with r (m,)."""
        by_row = self.local * r[:, None]
        c, at_station = by_row.shape[1] - self.axes, np.zeros((len(self.functions), self.axes))
        np.add.at(at_station, self.station, by_row[:, c:])
        return np.append(by_row[:, :c].sum(axis=0), at_station.T @ self.functions)

    def times(self, x: Array) -> Array:
        """Return the product (m,) of the matrix with x (p,)."""
        c = self.local.shape[1] - self.axes
        by_axes = self.functions @ x[c:].reshape(self.axes, self.functions.shape[1]).T
        change = (self.local[:, c:] * by_axes[self.station]).sum(axis=1)
        return np.asarray(self.local[:, :c] @ x[:c] + change)

    def propagated(self, covariance: Array, rows: NDArray[np.intp]) -> Array:
        """Return J C J' (s, count, count) of the rows of s stations, C (p, p) a covariance."""
        a, k = self.axes, self.functions.shape[1]
        c, local, f = self.local.shape[1] - a, self.local[rows], self.functions[
            self.station[rows[:, 0]]]
        # the covariance (s, c + a, c + a) of the change along each axis at each station
        at = np.empty((len(rows), c + a, c + a))
        at[:, :c, :c] = covariance[:c, :c]
        at[:, :c, c:] = (f @ covariance[:c, c:].reshape(c * a, k).T).reshape(len(f), c, a)
        at[:, c:, :c] = np.swapaxes(at[:, :c, c:], 1, 2)
        pairs = (f[:, :, None] * f[:, None]).reshape(len(f), k * k)
        both = covariance[c:, c:].reshape(a, k, a, k).swapaxes(1, 2).reshape(a * a, k * k)
        at[:, c:, c:] = (pairs @ both.T).reshape(len(f), a, a)
        return np.asarray(local @ at @ np.swapaxes(local, 1, 2))
