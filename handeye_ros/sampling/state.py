"""
What a person at the cell should know of a session, as one plain value.

Everybody who tells of a session (services, /diagnostics, ~/samples, ~/status, a page) reads it
from here, so that all say the same in the same sentences. SI units; see docs/session.md.
"""
from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

SAMPLES_FORMAT = 'handeye_ros/samples/1'
STATUS_FORMAT = 'handeye_ros/status/1'

NONE, CURRENT, OUTDATED, WITHDRAWN = 'none', 'current', 'outdated', 'withdrawn'


@dataclass(frozen=True)
class StreamState:
    """
    What comes in of one kind, 'profile' or 'pose'.

    place: the topic; count, malformed: good messages, and those that could not be understood;
    age: seconds since the last good one, or since the start; trouble: why nothing usable comes
    and what to do, empty where it does.
    """

    kind: str
    place: str
    count: int
    malformed: int
    age: float
    frame: str = ''
    trouble: str = ''


@dataclass(frozen=True)
class MotionState:
    """How the robot moves: m/s, rad/s, seconds it has stood still; text: the same in words."""

    standing: bool
    speed: float
    turning: float
    still: float
    text: str


@dataclass(frozen=True)
class SampleState:
    """
    One stop of the robot.

    taken: whether it gave a sample; excluded: whether samples.exclude leaves it out; believed:
    whether the fit uses it; text: what was seen, or why there is no sample; residual, left_out:
    RMS (m), None before there is a fit; translation, rotation: the flange in the base
    (quaternion x y z w), None without a sample.
    """

    number: int
    stamp: int
    taken: bool
    excluded: bool
    believed: bool
    text: str
    residual: float | None = None
    left_out: float | None = None
    translation: tuple[float, ...] | None = None
    rotation: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Attempt:
    """The one answer to an attempt to take a sample; number: 0 where there is none."""

    accepted: bool
    number: int
    text: str


@dataclass(frozen=True)
class SessionState:
    """
    Where a session is kept, and how samples are taken.

    path: its folder, empty before the first sample; mode: sampling.mode; working: what is being
    done now, in words; trouble: what stands in the way, and what to do; notes: what was dropped,
    or is odd, one sentence each.
    """

    path: str
    mode: str
    working: str = ''
    trouble: str = ''
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class CalibrationState:
    """
    The answer, and whether it is one.

    state: none, current, outdated (samples or settings have changed since) or withdrawn (there
    is none any more: what was published before is not the answer). T_parent_child: translation,
    rotation (x y z w), rpy; std: 1 sigma of x y z rx ry rz. All None where there is none. saved:
    the file that this answer was written to, empty before.
    """

    state: str
    text: str
    parent: str = ''
    child: str = ''
    translation: tuple[float, ...] | None = None
    rotation: tuple[float, ...] | None = None
    rpy: tuple[float, ...] | None = None
    std: tuple[float, ...] | None = None
    residual_rms: float | None = None
    holdout_rms: float | None = None
    used: int = 0
    rejected: int = 0
    saved: str = ''


@dataclass(frozen=True)
class SigmaState:
    """One direction's 1 sigma and its limit, in a unit: m or rad."""

    name: str
    std: float
    limit: float
    unit: str


@dataclass(frozen=True)
class GuidanceState:
    """
    What is advised next.

    sample: the number of the last sample that it knows of, 0 for none; text: all of it, beginning
    with that; sentences: the same one by one; enough: whether to stop, why: the reason;
    sigmas: of each direction, last that of mapped points, empty before there is an answer;
    translation, rotation: the flange in the base at the pose that helps most (quaternion
    x y z w), None before the sensor is roughly known; expected: 1 sigma of mapped points with
    it (m).
    """

    sample: int
    text: str
    sentences: tuple[str, ...]
    enough: bool
    why: str
    sigmas: tuple[SigmaState, ...] = ()
    translation: tuple[float, ...] | None = None
    rotation: tuple[float, ...] | None = None
    expected: float | None = None


@dataclass(frozen=True)
class State:
    """
    A session at one moment.

    samples: in the order of their numbers; worst: the numbers of the samples that have a
    left-out residual, worst first; review: why there are no residuals yet, empty where there
    are; attempt: the last one, None before; guidance: what is advised next, None before the
    first sample.
    """

    name: str
    profiles: StreamState
    poses: StreamState
    motion: MotionState
    session: SessionState
    samples: tuple[SampleState, ...]
    worst: tuple[int, ...]
    review: str
    attempt: Attempt | None
    calibration: CalibrationState
    guidance: GuidanceState | None = None

    @property
    def taken(self) -> int:
        """Return how many samples there are, those left out included."""
        return sum(sample.taken for sample in self.samples)

    @property
    def troubles(self) -> tuple[str, ...]:
        """Return all that stands in the way, one sentence each."""
        found = (self.profiles.trouble, self.poses.trouble, self.session.trouble)
        return tuple(filter(None, found))


def samples_message(state: State) -> dict[str, Any]:
    """Return what ~/samples carries, as plain values."""
    return {'format': SAMPLES_FORMAT, 'session': state.session.path, 'mode': state.session.mode,
            'samples': [asdict(sample) for sample in state.samples],
            'worst_first': list(state.worst), 'review': state.review,
            'attempt': asdict(state.attempt) if state.attempt else None}


def status_message(state: State) -> dict[str, Any]:
    """Return what ~/status carries, as plain values."""
    return {'format': STATUS_FORMAT, **asdict(state.calibration)}
