"""
Messages received by a running node: counts, clocks, latest ones, and the session.

Knows no ROS.
"""
from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass
import threading
import time
from typing import Protocol

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Array, Feature, TimedPose
from handeye_ros.errors import FeatureError, UnusableMessageError
from handeye_ros.sampling.session import Session, silent_poses
from handeye_ros.sampling.station_features import features_of
from handeye_ros.sampling.stops import Stop
from handeye_ros.sampling.stream import interpolate

MOST_STOPS = 16  # waiting for evaluation: at most 7 MB each with 1280 points a profile
KINDS = ('profile', 'pose')
LAST = 100  # messages of a kind that are kept: one of the two streams may be late
BAD_IN_A_ROW = 3  # consecutive invalid messages until they are reported
FRESH = 1.0  # s: the clocks are compared if the last messages of both kinds are not older
# s without a pose after which the pose is unknown: while profiles arrive, and if both stop
POSES_SILENT, BOTH_SILENT = 2.0, 30.0
PROFILES_COME = 1.0  # s since the last profile
LARGEST_APART = 5.0  # s: difference of the clocks that a slow network or a queue explains


class Arrivals:
    """Counts the messages of a node."""

    def __init__(self) -> None:
        """Start without messages."""
        self.counts = Counter({'profile': 0, 'pose': 0, 'malformed': 0})
        self.bad: Counter[str] = Counter()
        self.last_malformed = ''
        self._reasons: dict[str, str] = {}
        self._latest = dict.fromkeys(KINDS, time.monotonic())
        self._stamps: dict[str, int] = {}
        self._bad_in_a_row: Counter[str] = Counter()

    def received(self, kind: str, stamp: int) -> None:
        """Count a valid message; stamp: of its header, in ns."""
        self.counts[kind] += 1
        self._bad_in_a_row[kind] = 0
        self._latest[kind] = time.monotonic()
        self._stamps[kind] = stamp

    def malformed(self, kind: str, reason: str) -> None:
        """Count an invalid message."""
        self.counts['malformed'] += 1
        self.bad[kind] += 1
        self._bad_in_a_row[kind] += 1
        self.last_malformed = self._reasons[kind] = reason

    def unusable(self, kind: str) -> str:
        """Return a sentence if most, or the last, messages of a kind are invalid."""
        bad, good, last = self.bad[kind], self.counts[kind], self._bad_in_a_row[kind]
        if bad > good:
            count = f'{bad} of {bad + good} {kind}s'
        elif last >= BAD_IN_A_ROW:
            count = f'the last {last} {kind}s'
        else:
            return ''
        return f'{count} cannot be used; the last reason: {self._reasons[kind]}'

    def silence(self, kind: str) -> float:
        """Return the seconds since the last valid message, or since the start."""
        return time.monotonic() - self._latest[kind]

    @property
    def clocks(self) -> str:
        """Return a sentence if the clocks of profiles and poses differ, '' otherwise."""
        if any(kind not in self._stamps or self.silence(kind) > FRESH for kind in KINDS):
            return ''
        profile, pose = (self._stamps[kind] * 1e-9 + self.silence(kind) for kind in KINDS)
        ahead = profile - pose
        if abs(ahead) < LARGEST_APART:
            return ''
        size = f'{abs(ahead):.1f} s' if abs(ahead) < 3600 else f'{abs(ahead) / 3600:.2f} hours'
        return (f'the stamps of the profiles are {size} {"ahead of" if ahead > 0 else "behind"} '
                'those of the poses: the clocks of sensor and robot differ; set them to one time '
                '(PTP or NTP), or let one driver stamp as the other does')


@dataclass(frozen=True, eq=False)
class Current:
    """
    The current points (n, 2) and features in the sensor plane, at T_base_flange (4, 4).

    reason: why there are no features, empty where there are some.
    """

    T_base_flange: Array
    points: Array
    features: tuple[Feature, ...]
    reason: str = ''


class Latest:
    """The latest messages of both streams."""

    def __init__(self) -> None:
        """Start with none."""
        self._lock = threading.Lock()
        self._profiles: deque[AnyProfile] = deque(maxlen=LAST)
        self._poses: deque[TimedPose] = deque(maxlen=LAST)

    def add_profile(self, profile: AnyProfile) -> None:
        """Add a profile."""
        with self._lock:
            self._profiles.append(profile)

    def add_poses(self, poses: Iterable[TimedPose]) -> None:
        """Add poses."""
        with self._lock:
            self._poses.extend(poses)

    def clear(self) -> None:
        """Forget all messages: stamps may start again."""
        with self._lock:
            self._profiles.clear()
            self._poses.clear()

    @property
    def pose(self) -> Array | None:
        """Return T_base_flange (4, 4) of the last pose, None before the first."""
        with self._lock:
            last = self._poses[-1] if self._poses else None
        return None if last is None else se3.from_quaternion(last.translation, last.quaternion)

    def current(self, config: Config) -> Current | None:
        """Return the last usable profile with poses before and after it; None without one."""
        with self._lock:
            profiles = list(self._profiles)
            # of equal stamps, as in a repeated playback, the last pose counts
            by_stamp = {pose.stamp: pose for pose in self._poses}
        if len(by_stamp) < 2:
            return None
        poses = sorted(by_stamp.values(), key=lambda pose: pose.stamp)
        between_poses = [p for p in profiles if poses[0].stamp <= p.stamp <= poses[-1].stamp]
        if not between_poses:
            return None
        try:
            profile = between_poses[-1].read(config.profile)
        except UnusableMessageError:
            return None
        (T,) = interpolate(poses, [profile.stamp])
        try:
            return Current(T, profile.points, features_of(profile, config))
        except FeatureError as error:
            return Current(T, profile.points, (), str(error))


class StopConsumer(Protocol):
    """Receives the stops of the robot instead of the samples."""

    def add(self, stop: Stop, over: bool = True) -> str:
        """Add a stop; over: it is complete. Return the message."""

    def take(self, stop: Stop) -> str:
        """Add a requested stop; raises UnusableStopError."""


class Streams:
    """
    The streams of a running node, and its session.

    lock: for the session, held at most for one message; waiting: complete stops that are not yet
    evaluated; early: the current stop once it has enough profiles; wake: wakes the thread that
    evaluates them.
    """

    def __init__(self, config: Config) -> None:
        """Start empty; raises BadValueError for a method that does not exist."""
        self.config = config
        self.lock = threading.Lock()
        self.session = Session(config)
        self.waiting: deque[Stop] = deque()
        self.early: Stop | None = None
        self.wake = threading.Event()
        self.arrivals = Arrivals()
        self.latest = Latest()
        self._skipped = 0  # number of dropped stops

    def add_profile(self, profile: AnyProfile) -> None:
        """Add a profile."""
        self.arrivals.received('profile', profile.stamp)
        self.latest.add_profile(profile)
        with self.lock:
            self.session.add_profile(profile)
            self._queue_stops(self.session.passed())

    def add_poses(self, poses: Iterable[TimedPose]) -> None:
        """Add poses."""
        poses = list(poses)
        self.latest.add_poses(poses)
        with self.lock:
            for pose in poses:
                self.arrivals.received('pose', pose.stamp)
                self.session.add_pose(pose)
            self.early = self.session.early() or self.early
            self._queue_stops(self.session.passed())

    def _queue_stops(self, stops: Iterable[Stop]) -> None:
        """Queue stops for evaluation; drop the oldest if too many wait."""
        self.session.keep_waiting(MOST_STOPS)
        self.waiting.extend(stops)
        while len(self.waiting) > MOST_STOPS:
            self.waiting.popleft()
            self._skipped += 1
        if self.waiting or self.early:
            self.wake.set()

    def standing(self) -> Stop:
        """Return the current stop; raises DataError as the session does."""
        silence = self.arrivals.silence('pose')
        limit = POSES_SILENT if self.arrivals.silence('profile') < PROFILES_COME else BOTH_SILENT
        if self.arrivals.counts['pose'] and silence > limit:
            raise silent_poses(silence)
        with self.lock:
            return self.session.current_stop()

    def is_taken(self, stop: Stop) -> bool:
        """Return whether a stop was sampled or is to be ignored."""
        with self.lock:
            return self.session.is_taken(stop)

    def leave(self, stop: Stop) -> None:
        """Mark a stop as taken, so that it gives no sample."""
        with self.lock:
            self.session.leave(stop)

    def copied(self) -> Session:
        """Return a copy of the session at this moment."""
        with self.lock:
            return self.session.copied()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return a sentence if stops were dropped; empty otherwise."""
        return (f'left {self._skipped} stops out, the oldest of more than {MOST_STOPS} that '
                'waited to be evaluated: the processor cannot keep up; stop less often, or '
                'publish fewer points',) if self._skipped else ()
