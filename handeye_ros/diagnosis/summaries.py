"""What a sample shows, in words, and what was seen at each stop, to be drawn."""
from __future__ import annotations

from collections import Counter
from contextlib import suppress

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array, Reject, Sample
from handeye_ros.errors import UnusableMessageError
from handeye_ros.frames import in_mount
from handeye_ros.results.report.evidence import StopSnapshot
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Outcome, Seen
import numpy as np

NAMES = {'FaceLine': 'face line', 'EdgePoint': 'edge point', 'Arc': 'arc'}


def count_of(count: int, what: str) -> str:
    """Return `1 sample`, `2 samples`."""
    return f'{count} {what}' if count == 1 else f'{count} {what}s'


def sample_summary(sample: Sample | Reject) -> str:
    """Return what was seen in a sample, or why there is none."""
    if isinstance(sample, Reject):
        return sample.reason
    counts = Counter(NAMES[type(feature).__name__] for feature in sample.features)
    seen = ', '.join(count_of(count, name) for name, count in counts.items())
    return f'{seen} from {count_of(sample.profiles, "profile")}'


def stop_snapshots(session: Session, config: Config) -> tuple[StopSnapshot, ...]:
    """Return what was seen at the stops, in the order of their numbers; all count as unused."""
    return tuple(stop_snapshot(outcome, config) for outcome in session.outcomes)


def stop_snapshot(outcome: Outcome, config: Config) -> StopSnapshot:
    """Return what was seen at a stop."""
    seen, sample = outcome.stop.load(config), outcome.sample
    stamp = outcome.result.stamp
    T = sample.T_base_flange if sample else _middle(seen)
    return StopSnapshot(outcome.number, stamp, in_mount(T, config), _points(seen, stamp, config),
                        sample.features if sample else (), getattr(outcome.result, 'reason', ''),
                        samples=tuple(s.stamp for s in sample.single) if sample else ())


def _points(seen: Seen, stamp: int, config: Config) -> Array:
    """Return the points of the profile nearest to a stamp, none if it is unusable."""
    profile = min(seen.profiles, key=lambda p: abs(p.stamp - stamp), default=None)
    if profile is not None:
        with suppress(UnusableMessageError):
            return profile.read(config.profile).points
    return np.empty((0, 2))


def _middle(seen: Seen) -> Array:
    pose = seen.poses[len(seen.poses) // 2]
    return se3.from_quaternion(pose.translation, pose.quaternion)
