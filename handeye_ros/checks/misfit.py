"""By how much samples and poses contradict an answer, what it leaves unexplained, and refusals."""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros.checks.alternatives import LARGEST_DROPPED_SHARE
from handeye_ros.checks.change_point import require_unmoved
from handeye_ros.checks.errors import (
    ContradictingStationsError,
    InconsistentError,
    LostEdgesError,
    ScatterError,
    TooFewEdgesError,
)
from handeye_ros.checks.motion import require_certain
from handeye_ros.checks.shape import require_not_only_scale
from handeye_ros.config import LimitsConfig
from handeye_ros.estimation.consensus import Consensus
from handeye_ros.estimation.linearise import points_in_base, Problem
from handeye_ros.estimation.noise import expected_rms
from handeye_ros.estimation.search import shows_essential
from handeye_ros.estimation.solution import Solution
import numpy as np

MISFITTING = 9.0  # variance factor from which something other than noise is looked for
WILD, WILD_RATIO = 40.0, 4.0  # variance factor and residual over noise that no robot explains


@dataclass(frozen=True)
class Misfit:
    """By how much samples contradict an answer: RMS and expected RMS (m), share dropped."""

    rms: float
    expected: float
    share: float
    variance_factor: float
    limits: LimitsConfig

    @property
    def wild(self) -> bool:
        """Return whether the residuals are more than any noise."""
        return self.rms > self.limits.scatter * self.expected or (
            self.variance_factor > WILD and self.rms > WILD_RATIO * self.expected)

    @property
    def hopeless(self) -> bool:
        """Return whether there can be no answer."""
        return (self.share > LARGEST_DROPPED_SHARE or self.rms > self.limits.residual
                or self.wild)


def misfit_of(problem: Problem, agreed: Consensus) -> Misfit:
    """Return by how much the samples of a problem contradict what they agree on."""
    return Misfit(residual_rms(agreed.solution), expected_rms(agreed.solution.linear),
                  len(agreed.dropped) / len(problem.poses), agreed.solution.variance_factor,
                  problem.config.limits)


def require_consistent(problem: Problem, agreed: Consensus) -> None:
    """
    Refuse an answer that samples or poses contradict.

    Where the poses turn too little to tell anything, that is said, and not what may follow from
    it. Raises TooUncertainError, MovedError, ScaleError, InconsistentError,
    ContradictingStationsError or ScatterError.
    """
    misfit = misfit_of(problem, agreed)
    if misfit.hopeless:
        require_certain(agreed, problem.config)
        require_unmoved(problem, agreed)
    require_not_only_scale(agreed.solution)
    if misfit.rms > misfit.limits.residual:
        raise InconsistentError(misfit.rms, misfit.limits.residual)
    if misfit.share > LARGEST_DROPPED_SHARE:
        raise ContradictingStationsError(len(agreed.dropped), len(problem.poses))
    if misfit.wild:
        raise ScatterError(misfit.rms, misfit.expected, misfit.limits.scatter)


def residual_rms(solution: Solution) -> float:
    """Return the RMS of the plain residuals of a solution (m)."""
    return float(np.sqrt((solution.linear.residuals ** 2).mean()))


def require_edges(agreed: Consensus) -> None:
    """
    Refuse an answer that has no use for most edges that the stations show.

    What fits without them says nothing of them. Raises TooFewEdgesError or LostEdgesError.
    """
    method = agreed.whole.method
    if not method.essential:
        return
    used = int(shows_essential(agreed.solution.problem).sum())
    if used < method.minimum:
        raise TooFewEdgesError(method.name, used, len(agreed.used), method.minimum)
    shown = int(shows_essential(agreed.whole).sum())
    if shown - used > LARGEST_DROPPED_SHARE * shown:
        raise LostEdgesError(lost_edges(agreed))


def edge_notes(agreed: Consensus) -> list[str]:
    """Return which edges the answer has no use for, and which the samples never show, in words."""
    problem, lost = agreed.solution.problem, lost_edges(agreed)
    used = {problem.method.kinds[k] for k in set(problem.observations.kind)}
    edges = [{name.partition('_')[0] for name in names if name in problem.method.essential}
             for names in (problem.method.essential, used)]
    return [*([lost] if lost else []), *(
        f'no sample shows edge {edge} of the target: cross it too, or set target.type to line if '
        'the target has one edge only' for edge in sorted(edges[0] - edges[1]))]


def lost_edges(agreed: Consensus) -> str:
    """Return which edges the answer has no use for, in words, '' where it uses all."""
    if not len(agreed.unused):
        return ''
    shown = int(shows_essential(agreed.whole.subset(agreed.used)).sum())
    part, estimate = agreed.whole.subset(agreed.unused), agreed.solution.estimate
    where = part.method.measures.elsewhere(part.observations, points_in_base(part, estimate.X),
                                           estimate.target, part.config)
    return (f'the edges of {len(agreed.unused)} of the {shown} samples that show one lie on none '
            'of the target' + (f': {where}' if where else ''))
