"""
How large a doubt is, judged by what the data show of its unknowns.

The unknowns of a doubt are normal, and the size of them all, its standard deviation over the
configured one, is unknown too: Student's t in magnitude (Gelman 2006, Bayesian Analysis 1:515).
It is not taken as the likeliest, which is nothing as soon as few unknowns are small by chance,
but summed over.
"""
from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray

SIZES = np.geomspace(0.001, 1e4, 43)  # that are summed over
VARIANCES = SIZES ** 2
GROWN = 2.0  # times the variance before: less is no new cause


def _belief(freedom: float, scale: float) -> Array:
    """Return the logarithm of the prior of sizes, of equal steps in their logarithm."""
    return np.asarray(np.log(SIZES) - (freedom + 1) / 2 * np.log1p(
        VARIANCES / (freedom * scale ** 2)))


# As configured in the mean square, with so heavy a tail that it may be several times as much.
STATED = _belief(3.0, 0.8)
# The same of a doubt of one unknown, of whose size a single number tells: Cauchy's tail.
ALONE = _belief(1.0, 1.0)
# Nothing, unless the data show something: what an estimate is best made with.
LEAN = _belief(1.0, 0.01)


@dataclass(frozen=True, eq=False)
class Sizes:
    """
    Variances (d,) of doubts over the configured: for an estimate, and for what is stated.

    gain: (d,) logarithm of how much likelier the data are, were each as large as it may be.
    """

    lean: Array
    stated: Array
    gain: Array

    def one_grown(self, before: Array, alone: NDArray[np.bool_]) -> Sizes:
        """
        Return the sizes with only one of the doubts of one unknown (alone, (d,)) grown.

        before: (d,) their variances so far. Two doubts may explain the same, and were both
        large, neither would seem needed: that which explains most grows first.
        """
        growing = alone & (self.stated > GROWN * before)
        if growing.sum() < 2:
            return self
        best = int(np.argmax(np.where(growing, self.gain, -np.inf)))
        waits = growing & (np.arange(len(before)) != best)
        return Sizes(np.where(waits, np.minimum(self.lean, before), self.lean),
                     np.where(waits, before, self.stated), self.gain)


def sizes(covariance: Array, value: Array, first: NDArray[np.intp], size: Array, largest: Array
          ) -> Sizes:
    """
    Return the sizes of doubts.

    value (q,) and covariance (q, q) of their unknowns in units of their sigma, when the variance
    of each doubt is size (d,) times the configured one; first: (d,) ascending, where the unknowns
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
    fitted = v * gradient ** 2 / f
    evidence = 0.5 * np.add.reduceat(fitted - np.log(f), first, axis=1)
    evidence[v > largest] = -np.inf
    square = np.add.reduceat(v / f + (v * gradient / f) ** 2, first, axis=1)
    counts = np.array([block.stop - block.start for block in blocks])
    stated = np.where(counts == 1, ALONE[:, None], STATED[:, None])
    return Sizes(_matched(LEAN[:, None], evidence, np.add.reduceat(fitted, first, axis=1)),
                 _matched(stated, evidence, square), _gain(stated, evidence, size))


def _gain(belief: Array, evidence: Array, size: Array) -> Array:
    """Return the logarithms (d,) of the evidence (s, d) over all sizes, less that at the size."""
    posterior = belief - np.logaddexp.reduce(belief) + evidence
    now = [np.interp(np.log(own), np.log(VARIANCES), of_size)
           for own, of_size in zip(size, evidence.T, strict=True)]
    return np.asarray(np.logaddexp.reduce(posterior) - now)


def _matched(belief: Array, evidence: Array, moment: Array) -> Array:
    """Return the variances (d,) whose moments are the means of those (s, d) of all sizes."""
    posterior = belief + evidence
    weights = np.exp(posterior - posterior.max(axis=0))
    means = (weights * moment).sum(axis=0) / weights.sum(axis=0)
    return np.exp([np.interp(mean, of_size, np.log(VARIANCES))
                   for mean, of_size in zip(means, moment.T, strict=True)])
