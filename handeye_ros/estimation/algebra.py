"""Inverses of information that keep a direction that is not seen: its variance is large."""
from __future__ import annotations

from handeye_ros.data import Array
import numpy as np
from scipy.linalg import lapack

LARGEST_STD = 1e3  # stands for infinity (m or rad)
FREE = 1e-13  # relative information of a direction that is not seen


def covariance_of(J: Array) -> Array:
    """Return that (u, u) of the unknowns of whitened J (m, u); what it leaves free is cut."""
    few = len(J) < J.shape[1]  # then the free directions come with the whole basis only
    _, s, Vt = np.linalg.svd(J, full_matrices=few)
    values = np.zeros(len(Vt))
    values[:len(s)] = s
    root = Vt / np.maximum(values, 1 / LARGEST_STD)[:, None]
    return np.asarray(root.T @ root)


def inverse(information: Array) -> Array:
    """Return the inverse of a symmetric positive matrix, directions not seen cut."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / np.outer(scale, scale)
    scaled[np.diag_indices_from(scaled)] += FREE
    root, failed = lapack.dpotrf(scaled, lower=1)  # and zeros above it
    if failed:
        values, vectors = np.linalg.eigh(scaled)
        full = (vectors / np.maximum(values, FREE)) @ vectors.T
    else:
        lower, _ = lapack.dpotri(root, lower=1)
        full = lower + lower.T
        full[np.diag_indices_from(full)] /= 2
    return np.asarray(full / scale / scale[:, None])
