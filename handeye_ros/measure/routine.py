"""What a verification routine is: the shape it fits, and what it reads off it."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from handeye_ros.data import Array, Sample
from handeye_ros.estimation.method import Observations
import numpy as np
from numpy.typing import NDArray

BAGS = 10  # the kind of a condition is BAGS * the number of its bag + what it is of


@dataclass(frozen=True, eq=False)
class Seen:
    """
    What the stations of one bag saw.

    poses: (n, 4, 4) of what carries the sensor in what carries the target; observations: points
    of the sensor plane with their noise, kind: what they are of.
    """

    poses: Array
    observations: Observations


@dataclass(frozen=True)
class Nominal:
    """
    What is known of the artefact; metres.

    lengths: of the ball bar, heights of the steps, or pitch and height of the teeth; radius: of
    the spheres (0: unknown); reference: the touched point; aim: 1 sigma of how exactly the laser
    was put to the point.
    """

    lengths: tuple[float, ...] = ()
    radius: float = 0.0
    reference: tuple[float, ...] = ()
    aim: float = 0.0


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

    says: what it measures. target: the target.type whose features the stations give. bags: how
    many, least and most. lengths: of Nominal, how many for so many bags, -1 where any will do.
    observe(samples, poses (n, 4, 4), X): the conditions of one bag; shape(points (m, 3), kind
    (m,), nominal): what is fitted. names(count): name and unit of each value.
    """

    name: str
    says: str
    target: str
    bags: tuple[int, int]
    observe: Callable[[Sequence[Sample], Array, Array], Observations]
    shape: Callable[[Array, NDArray[np.intp], Nominal], Shape]
    names: Callable[[int], tuple[tuple[str, str], ...]]
    lengths: Callable[[int], int] = lambda bags: 0


def stacked(seen: Sequence[Seen]) -> Seen:
    """Return several bags as one, the number of the bag in the kind."""
    first = np.concatenate([[0], np.cumsum([len(s.poses) for s in seen])])
    obs = [s.observations for s in seen]
    return Seen(np.concatenate([s.poses for s in seen]), Observations(
        np.concatenate([o.station + n for o, n in zip(obs, first[:-1], strict=True)]),
        np.concatenate([o.points for o in obs]),
        np.concatenate([o.kind + BAGS * k for k, o in enumerate(obs)]),
        np.concatenate([o.noise for o in obs]), np.concatenate([o.source for o in obs])))
