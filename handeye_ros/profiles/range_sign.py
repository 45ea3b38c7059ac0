"""
Which way the range is counted, as the profiles themselves show it.

A face ends where the surface turns away from the sensor or drops. Read with the wrong sign, a
corner that turns away stands in front of the face instead, and there is no edge.
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from handeye_ros.config import Config
from handeye_ros.data import EdgePoint, Feature, Reject, Sample

EDGES = ('roof', 'step', 'shadow', 'gap')
TURNED_EDGES = ('roof', 'step', 'shadow')  # that the way of counting makes, or takes away
CHANCE = 0.01  # of so many more edges the other way, were both as likely
MOST_SHARE = 0.5  # of the stations may show an edge as set, if the sign is to be wrong
LEAST_SHARE = 0.8  # of the stations show an edge the other way, if it is


@dataclass(frozen=True)
class RangeSignEvidence:
    """
    In how many stations the target has an edge, by the way the range is counted.

    as_set: as profile.range_sign says; flipped: the other way; both: either way; total: of all
    stations.
    """

    as_set: int
    flipped: int
    both: int
    total: int

    @property
    def against(self) -> bool:
        """Return whether the stations speak against profile.range_sign (a sign test)."""
        if not self.total or self.as_set > MOST_SHARE * self.total:
            return False
        only_as_set, only_flipped = self.as_set - self.both, self.flipped - self.both
        return (self.flipped >= LEAST_SHARE * self.total
                and 2.0 ** -(only_flipped - 4 * only_as_set) < CHANCE)

    def hint(self, config: Config) -> str:
        """Return the sentence that says so, empty when the stations do not."""
        if not self.against:
            return ''
        sign = config.profile.range_sign
        return (f'with profile.range_sign {sign}, {self.as_set} of {self.total} stations show an '
                f'edge; counted the other way {self.flipped} of {self.total} do: set '
                f'profile.range_sign to {-sign} (or, if it is right, remove what is higher '
                'beside the target)')


def range_sign_evidence(stations: Iterable[Sample | Reject]) -> RangeSignEvidence:
    """
    Return what stations, with and without a sample, say of profile.range_sign.

    It needs no solution: a live node can ask after every stop. Ends of faces at the border of
    the field of view must be left out (view_border). Of targets without edges nothing is known,
    and the evidence is never against.
    """
    seen = [(isinstance(s, Sample) and _has_edge(s.features, EDGES),
             _has_edge(s.flipped, TURNED_EDGES)) for s in stations]
    return RangeSignEvidence(sum(a for a, _ in seen), sum(b for _, b in seen),
                             sum(a and b for a, b in seen), len(seen))


def _has_edge(features: Iterable[Feature], kinds: Sequence[str]) -> bool:
    return any(isinstance(f, EdgePoint) and f.kind in kinds for f in features)
