"""
Variance components: how large each of several causes of noise was, from the residuals.

Restricted maximum likelihood (Patterson and Thompson 1971, Biometrika 58:545), in multiplicative
fixed-point steps. A weak belief in the start keeps few residuals from proving a cause absent.
"""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.estimation.quantiles import chi2_median
import numpy as np

STEPS = 30
CONVERGED = 1e-2  # relative change of a variance that changes no answer
BELIEF = 0.5  # of the start, in degrees of freedom
SMALLEST_VARIANCE = 1e-24
ROUNDING = 1e-12  # keeps a covariance invertible that one cause rules


def variance_components(residuals: Array, jacobian: Array, parts: Array, start: Array) -> Array:
    """
    Return the variances (c,) of c causes.

    residuals: (n, k) of n independent blocks, at an adjusted state; jacobian: (n, k, u) of
    them; parts: (c, n, k, k) the covariances that a unit variance of each cause makes, which
    together are regular; start: (c,) a guess of the variances, all positive.
    """
    variances = start
    for _ in range(STEPS):
        whitener = _whitener(np.tensordot(variances, parts, 1))
        J, whitened = whitener @ jacobian, (whitener @ residuals[..., None])[..., 0]
        flat = J.reshape(-1, J.shape[2])
        unknowns = np.linalg.pinv(flat.T @ flat)
        r = whitened - J @ (unknowns @ (flat.T @ whitened.ravel()))
        W = (whitener @ parts @ np.swapaxes(whitener, 1, 2)) * variances[:, None, None, None]
        form = np.einsum('ni,cnij,nj->c', r, W, r, optimize=True)
        taken = np.einsum('nia,cnij,njb,ab->c', J, W, J, unknowns, optimize=True)
        expected = np.maximum(np.einsum('cnii->c', W) - taken, 0.0)
        factors = (form + BELIEF * start / variances) / (expected + BELIEF)
        variances = variances * factors
        if np.abs(np.log(factors)).max() < CONVERGED:
            break
    return np.asarray(variances)


def first_variances(residuals: Array, parts: Array) -> Array:
    """
    Return for each cause half the variance (c,) that it could have alone.

    residuals: (n, k), threes of which are vectors, such as translation and rotation; some may
    be wrong. parts as for variance_components.
    """
    n = len(residuals)
    lengths = np.linalg.norm(residuals.reshape(n, -1, 3), axis=2)
    predicted_covariance = np.median(lengths, axis=0) ** 2 / chi2_median(3)
    made = np.einsum('cnii->cni', parts).reshape(len(parts), n, -1, 3).mean(axis=(1, 3))
    alone = np.divide(predicted_covariance, made, out=np.full(made.shape, np.inf), where=made > 0)
    return np.asarray(np.maximum(alone.min(axis=1) / 2, SMALLEST_VARIANCE))


def _whitener(covariance: Array) -> Array:
    """Return the inverse Cholesky factors (n, k, k) of covariances (n, k, k)."""
    own = np.einsum('nii->ni', covariance)[..., None] * np.eye(covariance.shape[1])
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance + ROUNDING * own)))
