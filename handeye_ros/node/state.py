"""
The state of a running node as one plain value, and sentences about it.

Services, /diagnostics, ~/samples, ~/status and the page all report this value, so that they agree
and use the same sentences. SI units; see docs/cell.md.
"""
from __future__ import annotations

from dataclasses import asdict, dataclass
import math
from typing import Any

from handeye_ros import se3
from handeye_ros.checks.review import count_of
from handeye_ros.data import Calibration
import numpy as np

SAMPLES_FORMAT = 'handeye_ros/samples/1'
STATUS_FORMAT = 'handeye_ros/status/1'

NONE, CURRENT, OUTDATED, WITHDRAWN = 'none', 'current', 'outdated', 'withdrawn'


@dataclass(frozen=True)
class StreamState:
    """
    The messages of one kind, 'profile' or 'pose'.

    count, malformed: numbers of valid and invalid messages; age: seconds since the last valid one,
    or since the start; trouble: why no usable messages arrive and what to do, or ''.
    """

    kind: str
    topic: str
    count: int
    malformed: int
    age: float
    frame: str = ''
    trouble: str = ''


@dataclass(frozen=True)
class MotionState:
    """Motion of the robot: m/s, rad/s, seconds at rest; text: in words."""

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
    whether the fit uses it; text: its features, or why there is no sample; residual, left_out: RMS
    (m), None without a fit; translation, rotation: the flange in the base (quaternion x y z w),
    None without a sample.
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
    """Result of the last attempt to take a sample; number: 0 without a sample."""

    accepted: bool
    number: int
    text: str


@dataclass(frozen=True)
class SessionState:
    """
    Where the session is stored, and how samples are taken.

    path: its folder, empty before the first sample; mode: sampling.mode; working: the running
    tasks in words; trouble: why messages cannot be used, and what to do; notes: sentences on
    dropped or unusual data.
    """

    path: str
    mode: str
    working: str = ''
    trouble: str = ''
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class CalibrationState:
    """
    The answer and its state.

    state: none, current, outdated (samples or settings have changed since) or withdrawn (the
    transform that was published before is not valid). translation, rotation (x y z w), rpy: of the
    child in the parent; std: 1 sigma of x y z rx ry rz; all None without an answer. saved: the
    file of this answer, empty before it is saved.
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
    The guidance.

    sample: the number of the last sample that it includes, 0 for none; text: the complete text,
    with that number; sentences: its sentences; enough: whether the samples suffice, why: the
    reason; sigmas: of each direction, last that of mapped points, empty before there is an answer;
    translation, rotation: the flange in the base at the most useful next pose (quaternion
    x y z w), None before a first estimate of the sensor's pose; expected: 1 sigma of mapped points
    with it (m).
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
    The state of a running node at one time.

    samples: in the order of their numbers; worst: the numbers of the samples with a left-out
    residual, the largest first; review: why there are no residuals, '' where there are; attempt:
    the last one, or None; guidance: the advice, None before the first sample.
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
        """Return the number of samples, including excluded ones."""
        return sum(sample.taken for sample in self.samples)

    @property
    def troubles(self) -> tuple[str, ...]:
        """Return why messages cannot be used, one sentence for each cause."""
        return tuple(filter(None, (self.profiles.trouble, self.poses.trouble,
                                   self.session.trouble)))

    def with_trouble(self, text: str, success: bool, service: str) -> str:
        """
        Return the message of a service with the current troubles.

        A silent stream is reported if it explains a refusal, and by take_sample.
        """
        takes = service == 'take_sample'
        streams = [stream.trouble for stream in (self.profiles, self.poses)
                   if takes or not success and (
                       stream.count == 0 or stream.malformed > stream.count)]
        trouble = '; '.join(filter(None, (*streams, self.session.trouble)))
        return text if trouble in text else f'{text}; {trouble}'


def samples_message(state: State) -> dict[str, Any]:
    """Return the content of ~/samples, as plain values."""
    return {'format': SAMPLES_FORMAT, 'session': state.session.path, 'mode': state.session.mode,
            'samples': [asdict(sample) for sample in state.samples],
            'worst_first': list(state.worst), 'review': state.review,
            'attempt': asdict(state.attempt) if state.attempt else None}


def status_message(state: State) -> dict[str, Any]:
    """Return the content of ~/status, as plain values."""
    return {'format': STATUS_FORMAT, **asdict(state.calibration)}


def calibration_summary(calibration: Calibration) -> str:
    """Return the transform with its 1 sigma, and the residuals, in words."""
    T, quality = calibration.T_flange_sensor, calibration.quality
    std = np.sqrt(np.diag(calibration.covariance))
    position = ', '.join(f'{v * 1e3:.3f} ± {s * 1e3:.3f}'
                         for v, s in zip(T[:3, 3], std[:3], strict=True))
    angles = ', '.join(f'{math.degrees(v):.4f}' for v in se3.rpy(T))
    turns = ', '.join(f'{math.degrees(s):.4f}' for s in std[3:])
    return (f'{calibration.child_frame} in {calibration.parent_frame}: x, y, z = {position} mm; '
            f'roll, pitch, yaw = {angles} degrees (± {turns} about x, y, z); residual '
            f'{quality.residual_rms * 1e3:.3f} mm RMS, left out '
            f'{quality.holdout_rms * 1e3:.3f} mm; {count_of(quality.samples_used, "sample")} '
            f'used, {quality.samples_rejected} rejected; save it with ~/save_calibration')
