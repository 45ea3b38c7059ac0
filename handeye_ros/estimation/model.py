"""What is observed of a target, and the functions that set one target apart from another."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

from handeye_ros.config import Config
from handeye_ros.data import Array, Feature, Sample
from handeye_ros.errors import DataError
import numpy as np
from numpy.typing import NDArray

UNUSED = -1  # the kind of an observation that is not part of the target


@dataclass(frozen=True, eq=False)
class Observations:
    """
    Points of the sensor plane, each with one scalar condition.

    station: (m,) index of the pose, ascending; points: (m, 2) metres; kind: (m,) index of the
    condition in the method's kinds; noise: (m, 2, 2) factor L: the point's error is L @ e, e of
    unit covariance; source: (m,) observations of a station with equal source share e. component:
    (m,) 0 or 1: which variance factor its noise has, by default 0. A target may add arrays (m,
    ...) in a subclass.
    """

    station: NDArray[np.intp]
    points: Array
    kind: NDArray[np.intp]
    noise: Array
    source: NDArray[np.intp]
    component: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, dtype=np.intp))

    def __post_init__(self) -> None:
        """Set the component to the first where none is given."""
        if len(self.component) < len(self.station):
            object.__setattr__(self, 'component', np.zeros(len(self.station), dtype=np.intp))

    def __len__(self) -> int:
        """Return the number of conditions."""
        return len(self.station)

    def same(self, other: Observations) -> bool:
        """Return whether others are the same points with the same labels."""
        return (np.array_equal(self.kind, other.kind)
                and np.array_equal(self.station, other.station)
                and np.array_equal(self.points, other.points))

    def select(self, keep: NDArray[np.bool_ | np.intp]) -> Self:
        """Return some observations, by a mask or by their numbers."""
        return type(self)(*(getattr(self, f.name)[keep] for f in fields(self)))

    def in_base(self, poses: Array, X: Array) -> Array:
        """Return the points (m, 3) in the base, at poses (n, 4, 4) with the sensor at X (4, 4)."""
        in_mount = self.points @ X[:3, [0, 2]].T + X[:3, 3]
        T = poses[self.station]
        return np.asarray(np.einsum('mij,mj->mi', T[:, :3, :3], in_mount) + T[:, :3, 3])

    def repeated(self, stations: int, points: Array) -> Self:
        """Return the observations of one station repeated, with points (stations * m, 2)."""
        every = (getattr(self, f.name) for f in fields(self))
        many = type(self)(*(np.tile(v, (stations, *[1] * (v.ndim - 1))) for v in every))
        return replace(many, points=points, station=np.repeat(np.arange(stations), len(self)))


@dataclass(frozen=True, eq=False)
class PoseModel:
    """
    Poses that depend on parameters with a prior: a time offset, a robot's joints.

    evaluate(values (k,)): poses T_base_flange (N, 4, 4) of all samples, and twists (N, 6, k),
    their derivatives by the values: translation, and rotation vector about the flange's origin,
    both in the base frame. names, counts, stds: of the blocks of parameters in order, stds: 1
    sigma of the prior about 0. white: (k,) 1 sigma of independent errors of the values at each
    station, such as stamp jitter; None: none. stations: indices of the problem's stations among
    the N, None: all. least: see ParameterBlock. blocks: source of further blocks for such poses,
    or None.
    """

    evaluate: Callable[[Array], tuple[Array, Array]]
    names: tuple[str, ...]
    counts: tuple[int, ...]
    stds: tuple[float, ...]
    stations: NDArray[np.intp] | None = None
    least: float = 0.0
    blocks: Any = None
    white: Array | None = None

    def at(self, values: Array) -> tuple[Array, Array]:
        """Return the poses (n, 4, 4) and twists (n, 6, k) of the stations of a problem."""
        poses, twists = self.evaluate(values)
        return (poses, twists) if self.stations is None else (
            poses[self.stations], twists[self.stations])

    def subset(self, stations: NDArray[np.intp]) -> PoseModel:
        """Return the model of some of the stations."""
        kept = stations if self.stations is None else self.stations[stations]
        return replace(self, stations=kept)


@dataclass(frozen=True, eq=False)
class Estimate:
    """The transform from the mount to the sensor plane X (4, 4) and the target's state (s,)."""

    X: Array
    target: Array


@dataclass(frozen=True)
class Conditions:
    """Values g (m,) that should vanish, (1), and their derivatives by point and target."""

    g: Array
    dg_dp: Array
    dg_dtarget: Array


def _never(observations: Observations) -> bool:
    """Return False: an estimate that fits well is not on a wrong surface."""
    return False


def kind_unchanged(observations: Observations, points: Array, target: Array, config: Config
                   ) -> Observations:
    """Return the observations unchanged, for a target whose features cannot be confused."""
    return observations


def observed_points(sample: Sample, points: Array, kind: NDArray[np.intp]
                    ) -> tuple[Array, NDArray[np.intp]]:
    """Return points and kinds unchanged: each observation is a measured point."""
    return points, kind


# Plain functions, no lambdas: solutions are pickled between processes.
def _nothing_stated(config: Config) -> Array:
    return np.zeros(0)


def _known_shape(config: Config) -> Config | None:
    return None


def _nothing_to_say(observations: Observations, points: Array, target: Array, config: Config
                    ) -> str:
    return ''


@dataclass(frozen=True, eq=False)
class FeatureModel:
    """
    What a target shows in profiles.

    extract(points, config): features of one profile. observe(samples): their observations.
    measured(sample, points, kind): all measured points (k, 2) and their kinds, for the used
    observations (points, kind) of a sample. extract_each(profiles, config): features, or the
    error, of each of many profiles; faster than extract.
    """

    extract: Callable[[Array, Config], tuple[Feature, ...]]
    observe: Callable[[Sequence[Sample]], Observations]
    measured: Callable[[Sample, Array, NDArray[np.intp]],
                       tuple[Array, NDArray[np.intp]]] = observed_points
    extract_each: Callable[[Sequence[Array], Config],
                           Sequence[tuple[Feature, ...] | DataError]] | None = None


@dataclass(frozen=True, eq=False)
class Geometry:
    """
    The conditions of points on a target.

    conditions(points in base (m, 3), kind (m,), target (s,), config): see Conditions.
    retract(target (s,), delta (k,)): the target moved. free(config): (k,) which of its parameters
    are unknown. relabel(observations, points in base, target, config): kinds that fit better, for
    the next solve; UNUSED for an observation that belongs to nothing. ambiguous(observations):
    whether they may be of several alike surfaces, so that a wrong estimate may fit well.
    """

    conditions: Callable[[Array, NDArray[np.intp], Array, Config], Conditions]
    retract: Callable[[Array, Array], Array]
    free: Callable[[Config], NDArray[np.bool_]]
    relabel: Callable[[Observations, Array, Array, Config], Observations] = kind_unchanged
    ambiguous: Callable[[Observations], bool] = _never


@dataclass(frozen=True, eq=False)
class Measures:
    """
    The stated measures of a target, and what is reported of it.

    tolerances(config): (k,) 1 sigma of the parameters that are stated with one, 0 of all others;
    configured(config): (k,) the stated values. relax(config): the configuration with the target's
    shape (its last parameter) unknown, None where it is unknown already. describe(target, std
    (k,)): the target's estimate as plain values. one_axis: what rotations about one axis alone
    leave undetermined, in words. elsewhere(observations that do not lie on the target, points in
    base, target, config): where these lie, in words, '' where there is nothing to say.
    """

    describe: Callable[[Array, Array], dict[str, Any]]
    tolerances: Callable[[Config], Array] = _nothing_stated
    configured: Callable[[Config], Array] = _nothing_stated
    relax: Callable[[Config], Config | None] = _known_shape
    one_axis: str = 'the position along it is free'
    elsewhere: Callable[[Observations, Array, Array, Config], str] = _nothing_to_say


@dataclass(frozen=True, eq=False)
class Nuisances:
    """
    Nuisance parameters of a target's own.

    blocks: the Source (see blocks.py, which imports this module) of the target's blocks.
    feature_errors(linear): (m, 1) derivatives of the residuals by a unit-variance error of each
    feature, which replaces the blocks during the search.
    """

    blocks: Callable[[Any], Any]
    feature_errors: Callable[[Any], Array]


@dataclass(frozen=True, eq=False)
class Method:
    """
    One target's estimator, as plain functions; the solver is the same for all.

    kinds: names of the conditions; labels: names of the target's k parameters; essential: kinds
    of which a station must use one, if it shows any. minimum: fewest samples.
    guess(problem, rng): estimates to start from, best first.
    """

    name: str
    kinds: tuple[str, ...]
    labels: tuple[str, ...]
    essential: tuple[str, ...]
    minimum: int
    guess: Callable[[Any, np.random.Generator], Iterable[Estimate]]
    features: FeatureModel
    geometry: Geometry
    measures: Measures
    nuisances: Nuisances | None = None

    @property
    def essential_kinds(self) -> list[int]:
        """Return the essential kinds as indices into kinds."""
        return [k for k, name in enumerate(self.kinds) if name in self.essential]
