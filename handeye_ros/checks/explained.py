"""What of the evidence an answer explains: stations, and the edges that they show."""
from __future__ import annotations

from handeye_ros.checks.alternatives import LARGEST_DROPPED_SHARE
from handeye_ros.checks.errors import LostEdgesError, TooFewEdgesError
from handeye_ros.estimation.consensus import Consensus
from handeye_ros.estimation.linearise import points_in_base
from handeye_ros.estimation.search import shows_essential


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
