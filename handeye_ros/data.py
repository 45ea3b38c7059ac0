"""Frozen values that pass between the stages (docs/conventions.md): SI units, stamps in ns."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

from handeye_ros.config import ProfileConfig
import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
TIME_OFFSET, ROTATION_LAG = 'time_offset', 'rotation_lag'  # s; keys of what is estimated


@dataclass(frozen=True, eq=False)
class Profile:
    """
    One laser profile, in the sensor's own plane.

    points: (n, 2), along the laser line and range, in the order of the line, either way (a
    session sorts others); a row with NaN is a column without a return.
    axes: the signed axes of frame_id that the two columns of points run along.
    beside: the third coordinate in frame_id, across the plane (metres); it is not used.
    intensity: (n,) of the points, where it was asked for and the driver gives it.
    """

    stamp: int
    frame_id: str
    points: Array
    axes: tuple[str, str] = ('x', 'z')
    beside: float = 0.0
    intensity: Array | None = None

    def read(self, config: ProfileConfig | None = None) -> Profile:
        """Return itself: it has been read."""
        return self


@dataclass(frozen=True, eq=False)
class RawProfile:
    """
    A profile as it was received: most are never used, and converted only where they are.

    fetch: gives the serialised message from where it lies; convert: makes a profile of it as a
    configuration reads it, or raises UnusableMessageError; config: that of its topic; held: bytes
    of memory that it takes, 0 where it lies in a file. rows: profiles that are in it. reach: it
    was taken within so long before and after its stamp (ns).
    """

    stamp: int
    frame_id: str
    fetch: Callable[[], bytes]
    convert: Callable[[bytes, ProfileConfig], Profile]
    config: ProfileConfig
    held: int = 0
    rows: int = 1
    reach: tuple[int, int] = (0, 0)

    def read(self, config: ProfileConfig | None = None) -> Profile:
        """Return the profile, with the stamp given here; raises UnusableMessageError."""
        return replace(self.convert(self.fetch(), config or self.config), stamp=self.stamp)

    @property
    def points(self) -> Array:
        """Return the (n, 2) rows of the profile, read anew each time; see Profile."""
        return self.read().points

    def __deepcopy__(self, memo: Any) -> RawProfile:
        """Return itself: nothing in it changes."""
        return self


AnyProfile: TypeAlias = Profile | RawProfile


@dataclass(frozen=True, eq=False)
class TimedPose:
    """
    A pose of the flange in the robot's base.

    translation: (3,) metres; quaternion: (4,) x y z w of unit length.
    """

    stamp: int
    translation: Array
    quaternion: Array
    parent_frame: str = 'base'


@dataclass(frozen=True, eq=False)
class FaceLine:
    """
    The straight part of a profile across a face.

    centre: (2,) centroid of its points; direction: (2,) unit vector along it.
    spread: standard deviation of its points along it; std: 1 sigma of its offset at
    the centre, which is also that of its offset's change over one spread: the offsets at
    centre +- spread * direction are uncorrelated, each with sqrt(2) * std.
    points: (k, 2) normal points, the means of equal bins of its points, in their order, as
    measured; points_std: (k,) 1 sigma of each across the line. blocks: (m, 2) the means of
    finer bins, whose scatter tells these. All are empty where only the line is known.
    """

    centre: Array
    direction: Array
    spread: float
    std: float
    points: Array = field(default_factory=lambda: np.empty((0, 2)))
    points_std: Array = field(default_factory=lambda: np.empty(0))
    blocks: Array = field(default_factory=lambda: np.empty((0, 2)))


@dataclass(frozen=True, eq=False)
class EdgePoint:
    """
    Where a face ends.

    point: (2,) in the sensor plane, on the face line; direction: (2,) unit vector along the
    face line, out of the face; std: 1 sigma along the direction; std_across: 1 sigma across it;
    kind: 'step', 'shadow' (a step whose foot is hidden), 'roof' (its wall is seen), 'gap' (nothing
    behind it) or 'open' (the driver does not say).
    drop: (2,) from the point to the surface below it, of a rounded or bevelled edge whose wall
    is not in sight, 0 of others; shapes: (k + 1,) logarithms of how likely it is rounded by each
    of k radii, and bevelled, 0 for the likeliest, empty where nothing bends. arc: (2,) from the
    point to the middle of the end's arc, were it round; arc_std: 1 sigma of where that is along
    the direction.
    shape_std: 1 sigma of how far the edge is off since its shape is not known exactly, which all
    ends share.
    """

    point: Array
    direction: Array
    std: float
    std_across: float
    kind: str = 'step'
    drop: Array = field(default_factory=lambda: np.zeros(2))
    shapes: Array = field(default_factory=lambda: np.empty(0))
    arc: Array = field(default_factory=lambda: np.zeros(2))
    arc_std: float = 0.0
    shape_std: float = 0.0

    @property
    def bevel(self) -> float:
        """Return how far below the face line the plate was last seen."""
        return float(np.hypot(*self.drop))


@dataclass(frozen=True, eq=False)
class Arc:
    """
    The part of a profile on a sphere.

    points: (k, 2) normal points, each the mean of its bin of the arc; std: (k,) 1 sigma of
    each along the circle's normal. centre (2,), radius: the circle fitted through all points.
    raw: (n, 2) the points of the arc that the normal points stand for, as measured.
    """

    points: Array
    std: Array
    centre: Array
    radius: float
    raw: Array


Feature: TypeAlias = FaceLine | EdgePoint | Arc


@dataclass(frozen=True, eq=False)
class Sample:
    """
    A station: what was seen while the robot stood still, and where it stood.

    Or one profile of a robot that moves. stamp: of the first profile used; T_base_flange: (4, 4).
    flipped: what its first profile would show if the range were counted the other way, to tell a
    wrong setting. motion: of a robot that moves (sampling.trajectory); offsets: by how much later
    than the stamp its pose is, and the rotation than the position (s). single: of a pass, the
    samples of its profiles; its own is the middle one.
    """

    stamp: int
    T_base_flange: Array
    features: tuple[Feature, ...]
    profiles: int = 1
    flipped: tuple[Feature, ...] = ()
    motion: Any = None
    offsets: tuple[float, ...] = (0.0,)
    single: tuple[Sample, ...] = ()


@dataclass(frozen=True)
class TimeOffset:
    """Seconds to be added to the stamps of the profiles, and 1 sigma."""

    value: float
    std: float


@dataclass(frozen=True)
class Reject:
    """A sample that was not used, and why; flipped: as in Sample."""

    stamp: int
    reason: str
    flipped: tuple[Feature, ...] = ()


@dataclass(frozen=True)
class SampleReport:
    """What became of a sample: its residual RMS (metres), or the reason it was not used."""

    stamp: int
    used: bool
    edge: str = ''
    residual: float | None = None
    reason: str = ''


@dataclass(frozen=True)
class Quality:
    """
    How good the answer is; metres.

    residual_rms: of all used observations; holdout_rms: of the same, each predicted from
    a fit without its station; weakest_direction: a sentence; weakest_std: its 1 sigma
    (metres for a translation, radians for a rotation: the sentence says which).
    """

    samples_used: int
    samples_rejected: int
    residual_rms: float
    holdout_rms: float
    weakest_direction: str
    weakest_std: float


@dataclass(frozen=True, eq=False)
class Calibration:
    """
    The answer: T_flange_sensor (4, 4) and its 6x6 covariance (x y z rx ry rz, flange frame).

    With eye_on_base the parent is the robot's base. target: what else was estimated, as plain
    values; time_offset: where it was estimated; provenance: version, created, inputs, config.
    """

    name: str
    method: str
    parent_frame: str
    child_frame: str
    T_flange_sensor: Array
    covariance: Array
    target: Mapping[str, Any]
    quality: Quality
    samples: tuple[SampleReport, ...]
    provenance: Mapping[str, Any] = field(default_factory=dict)
    time_offset: TimeOffset | None = None
