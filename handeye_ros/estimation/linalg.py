"""Inverses of information that keep a direction that is not seen: its variance is large."""
from __future__ import annotations

from handeye_ros.data import Array
import numpy as np
from scipy.linalg import lapack

LARGEST_STD = 1e3  # stands for infinity (m or rad)
FEWEST, AT_ONCE, MOST_ROWS = 50, 200, 24  # triangles, and rows of each, inverted row by row
FREE = 1e-13  # relative information of a direction that is not seen
HALVED = 100  # rows from which a matrix is inverted by halves
SMALLEST_SHARE = 1e-14  # of a covariance, which rounding may make negative
NOTHING = 1e-280  # information, so small that its inverse is still a number


def covariance_of(J: Array) -> Array:
    """Return that (u, u) of the unknowns of whitened J (m, u); what it leaves free is cut."""
    few = len(J) < J.shape[1]  # then the free directions come with the whole basis only
    _, s, Vt = np.linalg.svd(J if few else np.linalg.qr(J, mode='r'))
    values = np.zeros(len(Vt))
    values[:len(s)] = s
    root = Vt / np.maximum(values, 1 / LARGEST_STD)[:, None]
    return np.asarray(root.T @ root)


def inverse(information: Array) -> Array:
    """Return the inverse of a symmetric positive matrix, directions not seen cut."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), NOTHING))
    return _inverse_of_scaled(information * scale * scale[:, None], scale)


def _inverse_of_scaled(scaled: Array, scale: Array) -> Array:
    """Return the inverse of a matrix that times scale (p,) from both sides has a diagonal of 1."""
    _diagonal(scaled)[:] += FREE
    try:
        full = _regular_inverse(scaled)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(scaled)
        full = (vectors / np.maximum(values, FREE)) @ vectors.T
    full *= scale
    full *= scale[:, None]
    return np.asarray(full)


def _regular_inverse(S: Array) -> Array:
    """
    Return the inverse of a symmetric positive matrix (p, p), of a large one by halves.

    Products of matrices are quicker than what LAPACK does. Raises LinAlgError.
    """
    if len(S) < HALVED:
        root, failed = lapack.dpotrf(S.T, lower=1)  # and zeros above it
        if failed:
            raise np.linalg.LinAlgError
        lower, _ = lapack.dpotri(root, lower=1, overwrite_c=1)
        full = lower + lower.T
        _diagonal(full)[:] /= 2
        return np.asarray(full)
    h, full = len(S) // 2, np.empty_like(S)
    first = _regular_inverse(S[:h, :h])
    across = S[h:, :h] @ first
    last = _regular_inverse(S[h:, h:] - across @ S[:h, h:])
    both = last @ across
    full[:h, :h], full[h:, h:] = first + across.T @ both, last
    full[h:, :h], full[:h, h:] = -both, -both.T
    return full


def _diagonal(matrix: Array) -> Array:
    """Return a view of the diagonal (p,), to change it."""
    return np.asarray(np.einsum('ii->i', matrix))


def from_information(N: Array, b: Array, units: Array, known: int) -> tuple[Array, Array]:
    """
    Return the unknowns (p,), and their covariance (p, p), that make residuals small.

    N (p, p), b (p,): information and gradient of whitened residuals for unknowns of unit size;
    sizes: (p,) by which they are larger; of the last so many, known, the variance is known to be
    1 beforehand.
    """
    diagonal = _diagonal(N) * units ** 2
    diagonal[len(b) - known:] += 1.0
    scale = 1 / np.sqrt(np.maximum(diagonal, NOTHING))
    both = units * scale
    scaled = N * both
    scaled *= both[:, None]
    _diagonal(scaled)[:] = diagonal * scale ** 2
    covariance = _inverse_of_scaled(scaled, scale)
    return covariance @ (-units * b), covariance


def from_conditions(A: Array, r: Array, known: int) -> tuple[Array, Array]:
    """
    Return the same from few whitened residuals r (m,) and their derivatives A (m, p).

    The unknowns known beforehand count as errors of the residuals first, and are what these
    errors then show of them (as in a Kalman filter): matrices of m and not of p rows are inverted.
    """
    free = A.shape[1] - known
    K = A[:, free:]
    V = K @ K.T
    _diagonal(V)[:] += 1.0
    root, _ = lapack.dpotrf(V.T, lower=1, overwrite_a=1)
    whitener, _ = lapack.dtrtri(root, lower=1, overwrite_c=1)
    white, r = whitener @ A, whitener @ r
    J, K = white[:, :free], white[:, free:]
    own = inverse(J.T @ J)
    x = -own @ (J.T @ r)
    predicted_covariance, covariance = J @ own, np.empty((A.shape[1], A.shape[1]))
    covariance[:free, :free] = own
    covariance[:free, free:] = -predicted_covariance.T @ K
    covariance[free:, :free] = covariance[:free, free:].T
    left = K - predicted_covariance @ (J.T @ K)
    covariance[free:, free:] = -K.T @ left
    _diagonal(covariance)[free:] += 1.0
    return np.append(x, -K.T @ (r + J @ x)), covariance


def inverse_of_lower(L: Array) -> Array:
    """Return the inverses (n, c, c) of lower triangles, of small ones many at a time."""
    n, c, _ = L.shape
    if c > MOST_ROWS or n < FEWEST:
        return np.asarray(np.linalg.inv(L))
    parts = [_row_by_row(L[first:first + AT_ONCE]) for first in range(0, n, AT_ONCE)]
    return np.concatenate(parts)


def _row_by_row(L: Array) -> Array:
    """Return the inverses (n, c, c) of lower triangles by forward substitution."""
    last = np.ascontiguousarray(np.moveaxis(L, 0, 2))
    found = np.zeros_like(last)
    for i in range(len(found)):
        found[i, i] = 1 / last[i, i]
        np.einsum('kn,kjn->jn', last[i, :i], found[:i, :i], out=found[i, :i])
        found[i, :i] *= -found[i, i]
    return np.moveaxis(found, 2, 0)


def covering(first: Array, second: Array) -> Array:
    """Return the least covariance (k, k) of which neither of two has more in any direction."""
    std = np.sqrt(np.diag(first))
    values, vectors = np.linalg.eigh(first / np.outer(std, std))
    roots = np.sqrt(np.maximum(values, SMALLEST_SHARE))
    root, inverse = std[:, None] * vectors * roots, (vectors / roots).T / std
    values, vectors = np.linalg.eigh(inverse @ second @ inverse.T)
    along = root @ vectors
    return np.asarray((along * np.maximum(values, 1.0)) @ along.T)
