"""
The session of a running node, fed by its streams; what follows from it is done by others.

Knows no ROS. The lock is held around the session alone, for as long as a message takes.
"""
from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
import threading

from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, TimedPose
from handeye_ros.ros.node.arrivals import Arrivals
from handeye_ros.ros.node.latest import Latest
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Stop

MOST_STOPS = 16  # that wait to be judged, of 7 MB at most with 1280 points a profile


class LiveStreams:
    """
    What a running node receives.

    on_change: called after whatever changes the state.
    """

    def __init__(self, config: Config) -> None:
        """Start with nothing; raises BadValueError for a method that does not exist."""
        self._lock = threading.Lock()  # of the session
        self._session = Session(config)
        self._stops: deque[Stop] = deque()  # over, but not yet judged
        self._skipped = 0  # of these, as too many waited
        self._wake = threading.Event()  # of a worker that judges them
        self._works: list[str] = []  # that take long
        self.config = config
        self.arrivals = Arrivals()
        self.latest = Latest()
        self.on_change: Callable[[], None] = lambda: None

    # what comes in

    def add_profile(self, profile: AnyProfile) -> None:
        """Take a profile."""
        self.arrivals.came('profile', profile.stamp)
        self.latest.add_profile(profile)
        with self._lock:
            self._session.add_profile(profile)
            self._put_off(self._session.passed())

    def add_poses(self, poses: Iterable[TimedPose]) -> None:
        """Take poses."""
        poses = list(poses)
        self.latest.add_poses(poses)
        with self._lock:
            for pose in poses:
                self.arrivals.came('pose', pose.stamp)
                self._session.add_pose(pose)
            self._put_off(self._session.passed())

    def _put_off(self, stops: Iterable[Stop]) -> None:
        """Leave stops to the worker, the newest where it cannot keep up."""
        self._session.keep_waiting(MOST_STOPS)
        self._stops.extend(stops)
        while len(self._stops) > MOST_STOPS:
            self._stops.popleft()
            self._skipped += 1
        if self._stops:
            self._wake.set()

    # what is known

    def copied(self) -> Session:
        """Return the session of this moment."""
        with self._lock:
            return self._session.copied()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return what was left out as the processor could not keep up, one sentence each."""
        return (f'left {self._skipped} stops out, the oldest of more than {MOST_STOPS} that '
                'waited to be judged: the processor cannot keep up; stop less often, or publish '
                'fewer points',) if self._skipped else ()

    @property
    def working(self) -> str:
        """Return what takes long and is being done, in words; empty for nothing."""
        return '; '.join(self._works)

    @contextmanager
    def _doing(self, work: str) -> Iterator[None]:
        """Tell that a work is being done."""
        self._works.append(work)
        try:
            self.on_change()
            yield
        finally:
            self._works.remove(work)
