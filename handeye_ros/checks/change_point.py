"""
Whether sensor or target moved in the middle of a recording.

Where the samples fit no answer, each part of the recording is fitted by itself. Where they do, a
move after station k is one more term of the model, r = J xi + K n + D_k beta + e with the prior
beta ~ N(0, S^2), of two sizes S, tested to first order at the answer: nothing is fitted again.
Twice the log of its Bayes factor is that over no move under the noise that explains the samples
best without one, be it as configured or as it was estimated; so a robot less accurate than stated
is no move.
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

from handeye_ros import se3
from handeye_ros.checks.alternatives import (
    DECISIVE,
    Fit,
    Hypothesis,
    RARE,
    require_stated,
    VERY_STRONG,
)
from handeye_ros.checks.errors import MovedError
from handeye_ros.data import Array
from handeye_ros.errors import DataError
from handeye_ros.estimation.consensus import Consensus, fast_consensus
from handeye_ros.estimation.linearise import points_in_base, Problem
from handeye_ros.estimation.noise import Noise, whitening
from handeye_ros.estimation.outliers import chi2_isf
from handeye_ros.estimation.posterior import BELIEF_NOISE, evaluated
from handeye_ros.estimation.solution import Solution
from handeye_ros.frames import mount_frame, target_frame
import numpy as np
from numpy.typing import NDArray

MOST_PARTED = 15  # stations after which a recording is parted and fitted again
MOST_CHANGES = 40  # stations after which a small move is looked for
STEP = np.repeat([2e-3, 5e-3], 3)  # prior 1 sigma of a small move (m, rad)
SIZES = (1.0, 0.25)  # over that, as likely beforehand: of a move that only just matters
HOPELESS = VERY_STRONG - DECISIVE  # evidence with which no other noise finds any


def require_unmoved(problem: Problem, agreed: Consensus) -> None:
    """Raise MovedError where two parts of a recording fit, each by itself, but not together."""
    n, fewest = len(problem.poses), problem.method.minimum
    if n < 2 * fewest:
        return
    stations = np.unique(np.linspace(fewest, n - fewest, MOST_PARTED).round().astype(int))
    level = DECISIVE + 2 * float(np.log(len(stations)))
    require_stated((agreed,), [_parted(problem, k) for k in stations.tolist()], level)


def _parted(problem: Problem, k: int) -> Hypothesis:
    """Return that something moved before station k."""
    every = np.arange(len(problem.poses))

    def refit() -> Fit | None:
        first = fast_consensus(problem.subset(every[:k]))
        rest = fast_consensus(problem.subset(every[k:])) if first else None
        return (first, rest) if first and rest else None
    return Hypothesis(refit, partial(_refusal, problem, k))


def _refusal(problem: Problem, k: int, fit: Fit) -> DataError:
    first, second = (part.solution for part in fit)
    delta = se3.difference(second.estimate.X, first.estimate.X)
    covariance = sum(part.reported[:6, :6] * max(part.variance_factor, 1.0)
                     for part in (first, second))
    total = len(problem.poses)
    if delta @ np.linalg.solve(covariance, delta) < chi2_isf(RARE, 6):
        return MovedError.target(k, total, target_frame(problem.config))
    move = se3.inverse(first.estimate.X) @ second.estimate.X
    return MovedError.sensor(k, total, float(np.linalg.norm(move[:3, 3])),
                             float(se3.angle(move[:3, :3])), mount_frame(problem.config))


def moved_slightly(agreed: Consensus) -> str:
    """
    Return what may have moved a little, and when, as a warning; '' where nothing did.

    Raises MovedError where the evidence is very strong.
    """
    found = change_point(agreed.solution)
    if found is None or found.evidence < 0:  # no move is likelier, at even odds beforehand
        return ''
    config = agreed.whole.config
    refusal = MovedError.slightly(
        int(agreed.used[found.station]), len(agreed.whole.poses), found.sensor,
        mount_frame(config) if found.sensor else target_frame(config),
        float(np.linalg.norm(found.step[:3])), float(np.linalg.norm(found.step[3:])))
    if found.evidence > VERY_STRONG:
        raise refusal
    return str(refusal)


@dataclass(frozen=True, eq=False)
class ChangePoint:
    """
    A move between two stations.

    station: the first one after it; sensor: whether the sensor moved, and not the target;
    step: (6,) translation and rotation in the mount or the base; evidence: twice the log of the
    Bayes factor against no move.
    """

    station: int
    sensor: bool
    step: Array
    evidence: float


def change_point(solution: Solution) -> ChangePoint | None:
    """Return the likeliest move at a solution, None where there are too few stations."""
    n, reported = len(solution.problem.poses), solution.conservative or solution
    few = 2 if solution.problem.pose_model is None else n // MOST_CHANGES  # of many a second
    changes = np.unique(np.linspace(few, n - few, MOST_CHANGES).round().astype(int))
    if n < 2 * solution.problem.method.minimum:
        return None
    found = [_best(reported, changes)]
    if found[0].evidence < HOPELESS:
        return None
    configured = evaluated(solution.problem, solution.estimate, Noise())
    solutions = (reported, configured, solution)
    found += [_best(other, changes) for other in solutions[1:]]
    scores = [_score(other) for other in solutions]
    gains = [one.evidence - score for one, score in zip(found, scores, strict=True)]
    best = int(np.argmax(gains))
    return replace(found[best], evidence=gains[best] + min(scores))


def _best(solution: Solution, changes: NDArray[np.intp]) -> ChangePoint:
    """Return the likeliest step at a solution, with its evidence under the noise of that."""
    gains, steps = _gains(solution, changes)
    kind, k = np.unravel_index(int(np.argmax(gains)), gains.shape)
    return ChangePoint(int(changes[k]), kind == 0, steps[kind, k], float(gains[kind, k]))


def _score(solution: Solution) -> float:
    """Return -2 log of the marginal likelihood of a solution, with the belief in its noise."""
    white = whitening(solution.problem, solution.linear, solution.noise)
    spread = -2 * sum(float(np.log(np.einsum('nii->ni', f)).sum()) for f in white.factors)
    factors = solution.noise.factors
    belief = BELIEF_NOISE * float((np.log(factors) + 1 / factors - 1).sum())
    return float(spread + np.linalg.slogdet(solution.information)[1] + solution.squares + belief)


def _gains(solution: Solution, changes: NDArray[np.intp]) -> tuple[Array, Array]:
    """
    Return 2 log of the Bayes factors (2, k) of k steps, (14), and the steps (2, k, 6).

    The first are of the sensor, the second of the target.
    """
    linear, C, J = solution.linear, solution.covariance, solution.jacobian
    white = whitening(solution.problem, linear, solution.noise)
    p = points_in_base(solution.problem, linear.estimate.X)
    of_target = np.concatenate([linear.by_base, se3.cross(p - p.mean(axis=0), linear.by_base)],
                               axis=1)
    D = white(np.hstack([linear.jacobian[:, :6], of_target]) * np.tile(STEP, 2))
    ends = np.append(np.searchsorted(solution.problem.observations.station, changes), len(D))
    rows = [slice(first, last) for first, last in zip(ends[:-1], ends[1:], strict=True)]
    own = _from_each([D[part].T @ D[part] for part in rows])
    cross = _from_each([J[part].T @ D[part] for part in rows])
    slope = _from_each([solution.white[part] @ D[part] for part in rows])
    both = own - np.swapaxes(cross, 1, 2) @ (C @ cross)
    inside = np.stack([both[:, :6, :6], both[:, 6:, 6:]])
    slopes = np.stack([slope[:, :6], slope[:, 6:]])
    gains = np.full(slopes.shape[:2], -np.inf)
    steps = np.zeros(slopes.shape)
    for size in SIZES:
        information = np.eye(6) + size ** 2 * inside
        step = size ** 2 * np.linalg.solve(information, slopes[..., None])[..., 0]
        gain = (slopes * step).sum(axis=2) - np.linalg.slogdet(information)[1]
        steps = np.where((gain > gains)[..., None], -step * STEP, steps)
        gains = np.maximum(gains, gain)
    return gains - 2 * np.log(len(SIZES)), steps


def _from_each(parts: list[Array]) -> Array:
    """Return the sums of each part and all after it."""
    return np.asarray(np.cumsum(np.array(parts[::-1]), axis=0)[::-1])
