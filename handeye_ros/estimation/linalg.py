"""Inverses of information that keep a direction that is not seen: its variance is large."""
from __future__ import annotations

from handeye_ros.data import Array
import numpy as np
from scipy.linalg import lapack

LARGEST_STD = 1e3  # stands for infinity (m or rad)
FREE = 1e-13  # relative information, or variance, that is rounding: nothing is known of it
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
    root, failed = lapack.dpotrf(scaled.T, lower=1)  # and zeros above it
    if not failed:
        lower, _ = lapack.dpotri(root, lower=1, overwrite_c=1)
        full = lower + lower.T
        _diagonal(full)[:] /= 2
    else:
        values, vectors = np.linalg.eigh(scaled)
        full = (vectors / np.maximum(values, FREE)) @ vectors.T
    full *= scale
    full *= scale[:, None]
    return np.asarray(full)


def _diagonal(matrix: Array) -> Array:
    """Return a view of the diagonal (p,), to change it."""
    return np.asarray(np.einsum('ii->i', matrix))


def from_information(N: Array, b: Array, units: Array, known: int) -> tuple[Array, Array]:
    """
    Return the solution -C b (p,) of normal equations, and its covariance C (p, p), as in (5).

    N (p, p), b (p,): information and gradient of whitened residuals; units: (p,) the units that
    the solution is in, 1 for unknowns and tau for nuisance parameters; the last so many, known,
    have a prior of unit variance in these.
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


def covering(first: Array, second: Array) -> Array:
    """Return the smallest covariance (k, k) that no one of two exceeds in any direction, (8)."""
    std = np.sqrt(np.diag(first))
    values, vectors = np.linalg.eigh(first / np.outer(std, std))
    roots = np.sqrt(np.maximum(values, FREE))
    root, inverse = std[:, None] * vectors * roots, (vectors / roots).T / std
    values, vectors = np.linalg.eigh(inverse @ second @ inverse.T)
    along = root @ vectors
    return np.asarray((along * np.maximum(values, 1.0)) @ along.T)
