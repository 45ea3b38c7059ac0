"""What a verification routine is: the shape it fits, and what it reads off it."""
from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from handeye_ros.data import Array, Sample
from handeye_ros.estimation.model import Observations
import numpy as np
from numpy.typing import NDArray

TEETH = 'teeth'  # the target of a routine that takes points while the robot moves
BAGS = 10  # the kind of a condition is BAGS * the number of its bag + what it is of


@dataclass(frozen=True, eq=False)
class Seen:
    """
    What the stations of one bag saw.

    poses: (n, 4, 4) of what carries the sensor in what carries the target; observations: points
    of the sensor plane with their noise, kind: what they are of. groups: (n,) which poses share
    their error, ascending; each has its own where there are none. stamps, bags: (n,) of the
    poses; surface: what was taken of several in sight, in words.
    """

    poses: Array
    observations: Observations
    groups: NDArray[np.intp] | None = None
    stamps: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    bags: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    surface: str = ''

    def __post_init__(self) -> None:
        """Take poses without stamps or bags for those of one bag."""
        for name in ('stamps', 'bags'):
            if len(getattr(self, name)) < len(self.poses):
                object.__setattr__(self, name, np.zeros(len(self.poses), dtype=np.int64))

    def without(self, groups: Collection[int]) -> Seen:
        """Return what the other groups of poses saw."""
        obs = self.observations
        left = np.isin(groups_of(self)[obs.station], list(groups), invert=True)
        return replace(self, observations=obs.select(left)) if len(groups) else self


@dataclass(frozen=True)
class Nominal:
    """
    What is known of the artefact; metres.

    lengths: of the ball bar, heights of the steps, or pitch and height of the teeth; radius: of
    the spheres (0: unknown); reference: the touched point; aim: 1 sigma of how exactly the laser
    was put to the point; flank: horizontal way of a tooth's flank (0: unknown); std: 1 sigma of
    all these values, as the artefact's certificate states it.
    """

    lengths: tuple[float, ...] = ()
    radius: float = 0.0
    reference: tuple[float, ...] = ()
    aim: float = 0.0
    flank: float = 0.0
    std: float = 0.0


@dataclass(frozen=True, eq=False)
class Shape:
    """
    A shape with k unknowns, fitted to points of the base.

    start: (k,); distance(points (m, 3), kind (m,), q (k,)): signed distances (m,) from it;
    values(q): what is read off it; nominals: the same as it should be, None where unknown.
    """

    start: Array
    distance: Callable[[Array, NDArray[np.intp], Array], Array]
    values: Callable[[Array], Array]
    nominals: tuple[float | None, ...]


@dataclass(frozen=True)
class Routine:
    """
    A way to verify a calibration.

    says: what it measures. target: the target.type whose features the stations give, or TEETH
    where points are taken while the robot moves. bags: how many, least and most; lengths: of
    Nominal, how many for so many bags. observe(samples, poses (n, 4, 4), X): the conditions of
    one bag; shape(seen, points (m, 3), nominal): what is fitted, and what takes part.
    names(count): name and unit of each value; spread(seen, X, fit): what single stations show
    beside the fit.
    """

    name: str
    says: str
    target: str
    bags: tuple[int, int]
    observe: Callable[[Sequence[Sample], Array, Array], Observations]
    shape: Callable[[Seen, Array, Nominal], tuple[Seen, Shape]]
    names: Callable[[int], tuple[tuple[str, str], ...]]
    lengths: Callable[[int], int] = lambda bags: 0
    spread: Callable[[Seen, Array, Any], tuple[Any, ...]] = lambda seen, X, found: ()


def groups_of(seen: Seen) -> NDArray[np.intp]:
    """Return for each pose (n,) the group that shares its error."""
    return np.arange(len(seen.poses)) if seen.groups is None else seen.groups


def stacked(seen: Sequence[Seen]) -> Seen:
    """Return several bags as one, the number of the bag in the kind."""
    first = np.cumsum([0, *(len(s.poses) for s in seen)])
    groups = np.cumsum([0, *(1 + groups_of(s).max(initial=-1) for s in seen)])
    obs = [s.observations for s in seen]
    return Seen(np.concatenate([s.poses for s in seen]), Observations(
        np.concatenate([o.station + n for o, n in zip(obs, first[:-1], strict=True)]),
        np.concatenate([o.points for o in obs]),
        np.concatenate([o.kind + BAGS * k for k, o in enumerate(obs)]),
        np.concatenate([o.noise for o in obs]), np.concatenate([o.source for o in obs])),
        np.concatenate([groups_of(s) + n for s, n in zip(seen, groups[:-1], strict=True)]),
        np.concatenate([s.stamps for s in seen]),
        np.repeat(np.arange(len(seen)), [len(s.poses) for s in seen]),
        '; '.join(f'recording {k}: {s.surface}' for k, s in enumerate(seen, 1) if s.surface))
