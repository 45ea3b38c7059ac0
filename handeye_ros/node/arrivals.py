# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Messages received by a running node: their counts, clocks, and the latest ones. No ROS."""
from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass
import threading
import time

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Array, Feature, TimedPose
from handeye_ros.errors import FeatureError, UnusableMessageError
from handeye_ros.sampling.features import features_of
from handeye_ros.sampling.stream import interpolate

KINDS = ('profile', 'pose')
KEPT = 100  # messages of a kind: one of the two streams may be late
BAD_IN_A_ROW = 3  # consecutive invalid messages until they are reported,
BAD_SHARE = 0.01  # or such a share of all, or of the messages lost in transit
FRESH = 1.0  # s: the clocks are compared if the last messages of both kinds are not older
LARGEST_APART = 5.0  # s: difference of the clocks that a slow network or a queue explains


class Arrivals:
    """Counts the messages of a node: valid, malformed, and lost ones by kind (profile, pose)."""

    def __init__(self) -> None:
        """Start without messages."""
        self.counts, self.malformed, self.lost = Counter[str](), Counter[str](), Counter[str]()
        self.last_malformed = ''
        self._reasons: dict[str, str] = {}
        self._latest = dict.fromkeys(KINDS, time.monotonic())
        self._stamps: dict[str, int] = {}
        self._bad_in_a_row: Counter[str] = Counter()

    def add(self, kind: str, stamp: int) -> None:
        """Count a valid message; stamp: of its header, in ns."""
        self.counts[kind] += 1
        self._bad_in_a_row[kind] = 0
        self._latest[kind] = time.monotonic()
        self._stamps[kind] = stamp

    def add_malformed(self, kind: str, reason: str) -> None:
        """Count an invalid message."""
        self.malformed[kind] += 1
        self._bad_in_a_row[kind] += 1
        self.last_malformed = self._reasons[kind] = reason

    def trouble(self, kind: str) -> str:
        """Return a sentence if many, or the last, messages of a kind are invalid or lost."""
        bad, lost, last = self.malformed[kind], self.lost[kind], self._bad_in_a_row[kind]
        total, sentences = bad + self.counts[kind], []
        if last >= BAD_IN_A_ROW or (bad >= BAD_IN_A_ROW and bad > BAD_SHARE * total):
            which = f'the last {last}' if last >= BAD_IN_A_ROW else f'{bad} of {total}'
            sentences.append(f'{which} {kind}s cannot be used; the last reason: '
                             f'{self._reasons[kind]}')
        if lost > BAD_SHARE * (total + lost):
            sentences.append(f'{lost} of {total + lost} {kind}s were lost on their way: let the '
                             'driver publish them reliably, or fewer or smaller ones')
        return '; '.join(sentences)

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

    def __init__(self, lock: threading.Lock) -> None:
        """Start with none; lock: that of the session."""
        self._lock = lock
        self._profiles: deque[AnyProfile] = deque(maxlen=KEPT)
        self._poses: deque[TimedPose] = deque(maxlen=KEPT)

    def add(self, profiles: Iterable[AnyProfile] = (), poses: Iterable[TimedPose] = ()) -> None:
        """Add messages."""
        with self._lock:
            self._profiles.extend(profiles)
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
