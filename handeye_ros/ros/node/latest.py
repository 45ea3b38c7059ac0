"""What the sensor sees now, and where it is: for those who watch, never for the answer."""
from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
import threading

from handeye_ros import methods
from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Array, Feature, TimedPose
from handeye_ros.errors import UnusableMessageError
from handeye_ros.profiles.errors import FeatureError
from handeye_ros.sampling.dwells import interpolate

KEPT = 100  # messages of a kind: the one of the two streams may be late


@dataclass(frozen=True, eq=False)
class Current:
    """
    What the sensor sees: points (n, 2) and features in its plane; T_base_flange (4, 4).

    reason: why there are no features, empty where there are.
    """

    T_base_flange: Array
    points: Array
    features: tuple[Feature, ...]
    reason: str = ''


class Latest:
    """The last messages of both streams."""

    def __init__(self) -> None:
        """Start with none."""
        self._lock = threading.Lock()
        self._profiles: deque[AnyProfile] = deque(maxlen=KEPT)
        self._poses: deque[TimedPose] = deque(maxlen=KEPT)

    def add_profile(self, profile: AnyProfile) -> None:
        """Take a profile."""
        with self._lock:
            self._profiles.append(profile)

    def add_poses(self, poses: Iterable[TimedPose]) -> None:
        """Take poses."""
        with self._lock:
            self._poses.extend(poses)

    def clear(self) -> None:
        """Forget them: time may start again."""
        with self._lock:
            self._profiles.clear()
            self._poses.clear()

    def current(self, config: Config) -> Current | None:
        """Return the last profile that poses surround; None where there is none to use."""
        with self._lock:
            profiles = list(self._profiles)
            # a recording that is played again, or two robots, repeat stamps: the last one counts
            of_stamp = {pose.stamp: pose for pose in self._poses}
        if len(of_stamp) < 2:
            return None
        poses = sorted(of_stamp.values(), key=lambda pose: pose.stamp)
        inside = [p for p in profiles if poses[0].stamp <= p.stamp <= poses[-1].stamp]
        if not inside:
            return None
        try:
            profile = inside[-1].read(config.profile)
        except UnusableMessageError:
            return None
        (T,) = interpolate(poses, [profile.stamp])
        try:
            return Current(T, profile.points, methods.of(config).extract(profile.points, config))
        except FeatureError as error:
            return Current(T, profile.points, (), str(error))
