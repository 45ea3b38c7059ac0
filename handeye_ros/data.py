# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Frozen values that pass between the stages (docs/contract.md): SI units, stamps in ns."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from numbers import Integral
from typing import Any, ClassVar, NamedTuple, TYPE_CHECKING, TypeAlias

from handeye_ros.config import ProfileConfig
from handeye_ros.errors import InputError, require_type, type_in_words
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from handeye_ros.sampling.trajectory import Trajectory

Array: TypeAlias = NDArray[np.float64]
Indices: TypeAlias = NDArray[np.intp]
SEED = 0  # of random searches: the same samples give the same answer
NS = 1_000_000_000  # nanoseconds in a second: stamps are in ns
# keys of estimated values: two times (s), and the seconds that the clock of the profiles loses in
# a second
TIME_OFFSET, ROTATION_LAG, CLOCK_DRIFT = 'time_offset', 'rotation_lag', 'clock_drift'
# noise.robot_smooth as found: 1 sigma of the smooth error of the robot along each axis (m); in
# kinematics.yaml `robot_smooth_error`
ROBOT_POSITION_ERROR = 'robot_position_error'
TURN_LENGTH = 0.3  # m: a joint error that turns the flange by 1 rad shifts it by this
QUATERNION_TOLERANCE = 1e-3  # of its length
ENDINGS = ('step', 'shadow', 'roof', 'gap', 'open')  # how a face ends; see EdgePoint
MAX_BACK_SHARE = 0.2  # way back of columns in order, over the way forth: at steps they jump


def has_return(points: Array) -> NDArray[np.bool_]:
    """Return which of points (n, 2) are finite."""
    return np.asarray(np.isfinite(points).all(axis=1))


def column_order(x: Array, is_return: NDArray[np.bool_]) -> Indices | slice:
    """
    Return the columns of a profile in order along its line, as indices into its columns.

    x: (n,) where they are on the line, NaN where unknown; is_return: (n,). They stay as they are,
    unless the returns run forth and back: then those with a place are sorted by it.
    """
    steps = np.diff(x[is_return])
    forth, back = steps[steps > 0].sum(), -steps[steps < 0].sum()
    if min(forth, back) <= MAX_BACK_SHARE * max(forth, back):
        return slice(None)
    with_place = np.isfinite(x).nonzero()[0]
    return np.asarray(with_place[np.argsort(x[with_place], kind='stable')])


@dataclass(frozen=True, eq=False)
class Profile:
    """
    One laser profile, in the sensor's own plane.

    stamp: the time at which it was taken (ns), on the clock of the poses
    frame_id: the name of the frame of the sensor, '' if its driver states none
    points: (n, 2) metres, along the laser line and range, ordered along the line in either
        direction (read sorts others); a row with NaN is a column without a return
    axes: the signed axes of frame_id that the two columns of points run along
    out_of_plane: the third coordinate in frame_id, across the plane (metres); it is not used
    intensity: (n,) of the points, None if not requested or not published
    held_bytes, time_margins: as of a RawProfile
    """

    stamp: int
    frame_id: str
    points: Array
    axes: tuple[str, str] = ('x', 'z')
    out_of_plane: float = 0.0
    intensity: Array | None = None
    held_bytes: ClassVar[int] = 0
    time_margins: ClassVar[tuple[int, int]] = (0, 0)

    def __post_init__(self) -> None:
        """Raise InputError for a stamp, a frame_id or points of another type or shape."""
        _require_stamp('profile', self.stamp)
        require_type('frame_id of a profile', self.frame_id, str)
        points = self.points
        if not isinstance(points, np.ndarray) or points.shape[1:] != (2,) or (
                points.dtype.kind != 'f'):
            raise InputError(f'points of a profile is {type_in_words(points)}, expected an array '
                             '(n, 2) of floats: along the laser line, and range (m)')

    def read(self, config: ProfileConfig | None = None) -> Profile:
        """
        Return this profile with its points in order along the laser line.

        config: of RawProfile.read, whose place it takes; these points are in metres already.
        Points in the origin become NaN: drivers publish the origin for missing returns.
        """
        points = np.where((self.points == 0).all(axis=1, keepdims=True), np.nan, self.points)
        columns = column_order(points[:, 0], np.isfinite(points[:, 0]))
        return replace(self, points=points[columns], intensity=(
            None if self.intensity is None else self.intensity[columns]))


@dataclass(frozen=True, eq=False)
class RawProfile:
    """
    A profile as it was received; its message is converted only when the profile is used.

    stamp, frame_id: as of a Profile
    fetch: returns the serialised message
    convert: makes a Profile of the message with a configuration, or raises UnusableMessageError
    config: the configuration that `read` uses where it is given none
    held_bytes: the memory that it takes, 0 if its message is still in a file
    profile_count: number of profiles in the message
    time_margins: it was taken at most this long before and after its stamp (ns)
    """

    stamp: int
    frame_id: str
    fetch: Callable[[], bytes]
    convert: Callable[[bytes, ProfileConfig], Profile]
    config: ProfileConfig
    held_bytes: int = 0
    profile_count: int = 1
    time_margins: tuple[int, int] = (0, 0)

    def read(self, config: ProfileConfig | None = None) -> Profile:
        """Return the profile, with the stamp given here; raises UnusableMessageError."""
        return replace(self.convert(self.fetch(), config or self.config), stamp=self.stamp)

    @property
    def points(self) -> Array:
        """Return the (n, 2) rows of the profile, read anew each time; see Profile."""
        return self.read().points


AnyProfile: TypeAlias = Profile | RawProfile


@dataclass(frozen=True, eq=False)
class TimedPose:
    """
    A pose of the flange in the robot's base, T_base_flange.

    stamp: the time at which the flange was there (ns)
    translation: (3,) the origin of the flange in the base (m)
    quaternion: (4,) the rotation as x y z w, of unit length
    parent_frame: the name of the frame of the base
    """

    stamp: int
    translation: Array
    quaternion: Array
    parent_frame: str = 'base'

    def __post_init__(self) -> None:
        """Raise InputError for a stamp or arrays of another form (numbers: require_values)."""
        _require_stamp('pose', self.stamp)
        for name, size in (('translation', 3), ('quaternion', 4)):
            values = getattr(self, name)
            if not isinstance(values, np.ndarray) or values.shape != (size,) or (
                    values.dtype.kind not in 'fiu'):
                raise InputError(f'{name} of a pose is {type_in_words(values)}, expected an array '
                                 f'({size},) of numbers')

    def require_values(self) -> None:
        """Raise InputError for numbers that are no pose; those of messages are checked there."""
        if not np.isfinite(self.translation).all():
            raise InputError(f'translation of a pose is {self.translation.tolist()}, expected '
                             'finite numbers (m)')
        if not abs(np.linalg.norm(self.quaternion) - 1.0) <= QUATERNION_TOLERANCE:
            raise InputError(f'quaternion of a pose is {self.quaternion.tolist()}, expected '
                             'x y z w of unit length')


def _require_stamp(what: str, stamp: object) -> None:
    if type(stamp) is not int and (isinstance(stamp, bool | np.unsignedinteger)
                                   or not isinstance(stamp, Integral)):
        raise InputError(f'stamp of a {what} is {stamp!r}, expected whole nanoseconds (int)')


@dataclass(frozen=True, eq=False)
class FaceLine:
    """
    The straight part of a profile across a face.

    centre: (2,) centroid of its points
    direction: (2,) unit vector along it
    spread: standard deviation of its points along it (m)
    std: 1 sigma of its offset at the centre, and of the change of the offset over one spread (m).
        So the offsets at centre +- spread * direction are uncorrelated, each with 1 sigma sqrt(2)
        * std.
    points: (k, 2) mean points: those of equal bins of measured points, in order
    points_std: (k,) 1 sigma of each across the line
    bins: (m, 2) means of finer parts, whose scatter gives std and points_std. All three are empty
        if only the line is known.
    """

    centre: Array
    direction: Array
    spread: float
    std: float
    points: Array = field(default_factory=lambda: np.empty((0, 2)))
    points_std: Array = field(default_factory=lambda: np.empty(0))
    bins: Array = field(default_factory=lambda: np.empty((0, 2)))
    noun: ClassVar[str] = 'face line'

    @property
    def polyline(self) -> Array:
        """Return its ends and its centre (3, 2), in order."""
        return np.insert(self.ends, 1, self.centre, axis=0)

    @property
    def ends(self) -> Array:
        """Return its ends (2, 2): of evenly spread points they are sqrt(3) spreads away."""
        return self.centre + np.outer([-1.0, 1.0], 3 ** 0.5 * self.spread * self.direction)


@dataclass(frozen=True, eq=False)
class EdgePoint:
    """
    Where a face ends.

    point: (2,) in the sensor plane, on the face line
    direction: (2,) unit vector along the face line, out of the face
    std: 1 sigma along the direction
    std_across: 1 sigma across it
    ending: of ENDINGS: 'step', 'shadow' (a step whose foot is hidden), 'roof' (its wall is seen),
        'gap' (nothing beyond it) or 'open' (the driver does not say)
    to_lowest: (2,) down to where the plate was last seen, of a rounded or bevelled edge without a
        visible wall, else 0: from the point or, once corrected, as deep as what was measured
    shape_log_likelihoods: (k + 1,) of roundings with k radii and of a bevel, 0 for the best, empty
        without a bend
    rounding_offset: (2,) from the point as seen to where its rounding is located best, if it is
        one
    rounding_std: 1 sigma of this place along the direction, for a given radius
    shape_std: 1 sigma of the edge position from its uncertain shape, common to all ends
    is_corrected: whether it is where face and wall meet by that shape, no longer where it was seen
    """

    point: Array
    direction: Array
    std: float
    std_across: float
    ending: str = 'step'
    to_lowest: Array = field(default_factory=lambda: np.zeros(2))
    shape_log_likelihoods: Array = field(default_factory=lambda: np.empty(0))
    rounding_offset: Array = field(default_factory=lambda: np.zeros(2))
    rounding_std: float = 0.0
    shape_std: float = 0.0
    is_corrected: bool = False
    noun: ClassVar[str] = 'edge point'

    @property
    def polyline(self) -> Array:
        """Return the point, as the only one (1, 2) of what is drawn."""
        return self.point[None]


@dataclass(frozen=True, eq=False)
class Arc:
    """
    The part of a profile on a sphere.

    points: (k, 2) mean points, each the mean of its bin of the arc
    std: (k,) 1 sigma of each along the circle's normal
    centre (2,), radius: the circle fitted through all points
    measured: (n, 2) the points of the arc that the mean points stand for, as measured
    """

    points: Array
    std: Array
    centre: Array
    radius: float
    measured: Array
    noun: ClassVar[str] = 'arc'

    @property
    def polyline(self) -> Array:
        """Return its mean points (k, 2)."""
        return self.points

    @property
    def circle(self) -> Array:
        """Return the circle as (x, z, radius)."""
        return np.append(self.centre, self.radius)


# Each has a noun, and a polyline: points (k, 2) in order that show where it is.
Feature: TypeAlias = FaceLine | EdgePoint | Arc


class ClockValues(NamedTuple):
    """Offset and lag (s), and drift of the clocks of a moving robot, see sampling/sweep.py."""

    offset: float = 0.0
    lag: float = 0.0
    drift: float = 0.0


@dataclass(frozen=True, eq=False)
class Sample:
    """
    What a stop gives, or one profile of a moving robot: the features seen, and the pose.

    stamp: that of the first profile used, of a pass that of its middle one (ns)
    T_base_flange: (4, 4) the pose of the flange in the robot's base
    features: what its profiles show of the target, in the sensor plane
    profile_count: how many profiles it comes from
    flipped_features: of the first profile with the opposite range sign, to detect a wrong setting;
        None where they were not asked for, () of a target without edges or where none are seen
    trajectory: of its pass, after passes_expanded of the whole sweep; None at a stop
    clock_values: by which a moving robot has this pose at the stamp; 0 before they are known
    profile_samples: samples of the single profiles of a pass, whose middle one this sample repeats
    centroid: mean of the points of the first profile used, (3,): across its plane, along the line,
        and range (metres); None where it is unknown
    """

    stamp: int
    T_base_flange: Array
    features: tuple[Feature, ...]
    profile_count: int = 1
    flipped_features: tuple[Feature, ...] | None = None
    trajectory: Trajectory | None = None
    clock_values: ClockValues = ClockValues()
    profile_samples: tuple[Sample, ...] = ()
    centroid: Array | None = None

    @property
    def moving(self) -> bool:
        """Return whether the robot moved: then the pose depends on the clocks."""
        return self.trajectory is not None

    @property
    def station_samples(self) -> tuple[Sample, ...]:
        """Return the sample of each of its stations: of a pass one per profile, else this one."""
        return self.profile_samples or (self,)

    def is_used(self, used: Mapping[int, bool]) -> bool:
        """
        Return whether an answer uses it, of a pass at least half of its profiles in the answer.

        used: of the stations of the answer, by their stamps.
        """
        stations = [used[each.stamp] for each in self.station_samples if each.stamp in used]
        return 2 * sum(stations) >= max(len(stations), 1)


@dataclass(frozen=True)
class BudgetTerm:
    """
    A part of the reported covariance by its 1 sigma; the squares of all parts add up.

    translation (m), rotation (rad): root of the mean over the axes; mapped (m): RMS error of
    points of the field of view, mapped by the transform.
    """

    name: str
    translation: float
    rotation: float
    mapped: float


@dataclass(frozen=True)
class ClockEstimate:
    """
    A parameter of the clocks (seconds; drift: seconds per second) and 1 sigma.

    As time_offset of a Calibration: seconds to be added to the stamps of the profiles.
    """

    value: float
    std: float


@dataclass(frozen=True)
class Reject:
    """
    A stop, or a profile of a pass, that gave no sample, and why.

    stamp: of a stop its own, that of its first pose; of a profile, or where features were found,
        that of the sample (ns)
    reason: a sentence for the user
    final: whether the reason holds whatever the profiles show, as of a stop that is excluded or
        cannot be evaluated again
    """

    stamp: int
    reason: str
    final: bool = False


@dataclass(frozen=True)
class SampleReport:
    """
    What became of a sample: its residual, and why it was not used, or not all of it.

    stamp: of the sample (ns); of a table the number of its row
    used: whether the answer uses it
    edge: kinds of the target's edges that it shows, as p, q; of a table the kind of its row
    residual: RMS (m)
    reason: why it was not used, or not all of it; '' otherwise
    """

    stamp: int
    used: bool
    edge: str = ''
    residual: float | None = None
    reason: str = ''


@dataclass(frozen=True)
class Quality:
    """
    How good an answer is.

    samples_used, samples_rejected: how many samples the answer uses, and how many it does not
    residual_rms: RMS distance of all used observations from the estimated target (m)
    holdout_rms: the left-out RMS: the same, each observation predicted from a fit without its
        station; of many stations, without it and some others (m)
    weakest_direction: the direction in which the position is least certain, in words
    weakest_std: 1 sigma of the position in this direction (m)
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
    The answer: the pose of the sensor in its mount, and what else was estimated.

    The mount is the flange; with eye_on_base it is the robot's base.

    name: of the calibration; method: of the estimator
    parent_frame, child_frame: the names of the frames of the mount and of the sensor
    T_flange_sensor: (4, 4) the pose of the sensor in the mount
    covariance: (6, 6) of x y z rx ry rz, a small shift and turn in the axes of the mount (m, rad)
    target: the other estimates, of target, robot and sensor, as plain values by key
    quality: its residuals
    samples: what became of each sample, by stamp
    provenance: version, created, inputs and config, as plain values
    time_offset: what is to be added to the stamps of the profiles; None where it was not estimated
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
    time_offset: ClockEstimate | None = None

    @property
    def rotation_lag(self) -> float:
        """Return by how much the robot reports its rotation later than its position (s)."""
        return float(self.target.get(ROTATION_LAG, 0.0))


@dataclass(frozen=True)
class Agreement:
    """
    RMS distances of a sample's points to the target of an answer, in metres.

    residual: from the answer
    left_out: from the answer without this sample; the same as residual for a sample that the
        answer does not use, and for the only one that it uses
    used: whether the answer uses it
    """

    residual: float
    left_out: float
    used: bool


@dataclass(frozen=True, eq=False)
class StopSnapshot:
    """
    What the report and the page show of a stop: one profile, its features, whether it is used.

    number: counted from 1; 0 of what is seen now
    stamp: that of its sample or reject, of what is seen now that of the profile (ns)
    T_fixed_mount: (4, 4) pose of the mount of the sensor in the frame where the target is fixed
    points: (n, 2) of one of its profiles, in the sensor plane (m); none where only the pose and
        the features are drawn
    features: what its profiles show, in the sensor plane (m)
    reason: why it was not used, empty if it was
    agreement: with the answer, None where it was not used
    """

    number: int
    stamp: int
    T_fixed_mount: Array
    points: Array
    features: tuple[Feature, ...] = ()
    reason: str = ''
    agreement: Agreement | None = None

    @property
    def used(self) -> bool:
        """Return whether the answer uses the stop."""
        return not self.reason
