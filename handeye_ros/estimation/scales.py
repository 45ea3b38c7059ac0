"""
The scales of priors, (6) of estimator.md, and variance components, from the residuals.

The parameters of a block are normal, and the scale of them all, their standard deviation over the
configured one, is unknown too, with a half-t prior (Gelman 2006, Bayesian Analysis 1:515). The
most likely scale is nothing as soon as few parameters are small by chance: it is summed over.

Variance components by restricted maximum likelihood (Patterson and Thompson 1971, Biometrika
58:545), in multiplicative fixed-point steps. A weak prior keeps few residuals from proving a cause
absent.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

from handeye_ros.data import Array
from handeye_ros.estimation.noise import inverse_roots
from handeye_ros.estimation.outliers import chi2_median
import numpy as np
from numpy.typing import NDArray

SCALES = np.geomspace(0.001, 1e4, 43)  # that are summed over
VARIANCES = np.square(SCALES)
LOGARITHMS = np.log(VARIANCES)
STEPS = 30  # of estimating variance components
CONVERGED = 1e-2  # relative change of a variance that changes no answer
BELIEF = 0.5  # of the start, in degrees of freedom
SMALLEST_VARIANCE = 1e-24
GROWN = 2.0  # times the variance before: less is no new cause


def _belief(freedom: float, scale: float) -> Array:
    """Return the logarithm of the prior of sizes, of equal steps in their logarithm."""
    return np.asarray(np.log(SCALES) - (freedom + 1) / 2 * np.log1p(
        VARIANCES / (freedom * scale ** 2)))


# As configured in the mean square, with so heavy a tail that it may be several times as much.
CONSERVATIVE = _belief(3.0, 0.8)
# The same of a block of one parameter, of whose scale a single number says little. Not Cauchy's:
# with that a sigma grows by half and more as samples come that fit (see estimator.md).
ALONE = _belief(2.0, 0.8)
# Nothing, unless the data show something: what an estimate is best made with.
MAP = _belief(1.0, 0.01)


@dataclass(frozen=True, eq=False)
class Scales:
    """
    The prior scales of d blocks, as variances over the configured ones.

    before: (d,) their variances so far; evidence: (s, d) log likelihood (6) at each of SCALES;
    fitted: (s, d) the gain, the first term of (6); square: (s, d) sum of the second moments of the
    parameters there; alone: (d,) whether a block has one parameter only.
    """

    before: Array
    evidence: Array
    fitted: Array
    square: Array
    alone: NDArray[np.bool_]

    @cached_property
    def map_scales(self) -> Array:
        """Return the variances (d,) for an estimate."""
        grown = _matched(MAP[:, None], self.evidence, self.fitted)
        return np.where(self._waiting, np.minimum(grown, self.before), grown)

    @cached_property
    def conservative(self) -> Array:
        """Return the variances (d,) for what is stated of an estimate."""
        return np.where(self._waiting, self.before, self._each_conservative)

    @cached_property
    def _waiting(self) -> NDArray[np.bool_]:
        """
        Return which of the blocks of one parameter (d,) do not grow while another does.

        Two of them may explain the same, and were both large, neither would seem needed: that
        which explains most grows first.
        """
        growing = self.alone & (self._each_conservative > GROWN * self.before)
        if growing.sum() > 1:
            growing[np.argmax(np.where(growing, self._gain, -np.inf))] = False
            return growing
        return np.zeros(len(growing), dtype=bool)

    @cached_property
    def _each_conservative(self) -> Array:
        return _matched(self._belief, self.evidence, self.square)

    @property
    def _belief(self) -> Array:
        return np.where(self.alone, ALONE[:, None], CONSERVATIVE[:, None])

    @property
    def _gain(self) -> Array:
        """Return how much likelier (d,) the data are over all sizes than at that before."""
        belief = self._belief
        posterior = belief - np.logaddexp.reduce(belief) + self.evidence
        now = [np.interp(np.log(own), LOGARITHMS, of_size)
               for own, of_size in zip(self.before, self.evidence.T, strict=True)]
        return np.asarray(np.logaddexp.reduce(posterior) - now)


def prior_scales(covariance: Array, value: Array, first: NDArray[np.intp], size: Array,
                 largest: Array) -> Scales:
    """
    Return the scales of blocks, (6).

    value (q,) and covariance (q, q) of their unknowns in units of their sigma, when the variance
    of each block is size (d,) times the configured one; first: (d,) ascending, where the unknowns
    of each begin; largest: (d,) the variance beyond which there is none.
    """
    blocks = [slice(*ends) for ends in pairwise([*first.tolist(), len(value)])]
    shares, along = np.empty(len(value)), np.empty(len(value))
    for block in blocks:
        if block.stop == block.start + 1:
            shares[block], along[block] = covariance[block, block], value[block]
            continue
        own, axes = np.linalg.eigh(covariance[block, block])
        shares[block], along[block] = own, axes.T @ value[block]
    shares = np.clip(shares, 1e-12, 1 - 1e-9)
    now = np.repeat(size, np.diff([*first, len(value)]))
    # what the data alone say, all other unknowns free: information and its gradient
    information, gradient = (1 / shares - 1) / now, along / (shares * np.sqrt(now))
    v = VARIANCES[:, None]
    f = 1 + v * information
    known = v / f
    fitted = known * gradient ** 2
    evidence = 0.5 * np.add.reduceat(fitted - np.log(f), first, axis=1)
    evidence[v > largest] = -np.inf
    square = np.add.reduceat(known * (1 + fitted), first, axis=1)
    alone = np.array([block.stop == block.start + 1 for block in blocks])
    return Scales(size, evidence, np.add.reduceat(fitted, first, axis=1), square, alone)


def _matched(belief: Array, evidence: Array, moment: Array) -> Array:
    """Return the variances (d,) whose moments are the means of those (s, d) of all sizes."""
    posterior = belief + evidence
    weights = np.exp(posterior - posterior.max(axis=0))
    means = (weights * moment).sum(axis=0) / weights.sum(axis=0)
    return np.exp([np.interp(mean, of_size, LOGARITHMS)
                   for mean, of_size in zip(means, moment.T, strict=True)])


def variance_components(residuals: Array, jacobian: Array, parts: Array, start: Array) -> Array:
    """
    Return the variances (c,) of c causes.

    residuals: (n, k) of n independent blocks, at an adjusted state; jacobian: (n, k, u) of
    them; parts: (c, n, k, k) the covariances that a unit variance of each cause makes, which
    together are regular; start: (c,) a guess of the variances, all positive.
    """
    variances = start
    for _ in range(STEPS):
        whitener = inverse_roots(np.tensordot(variances, parts, 1))
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
