"""What was taken and answered, in words, and what was seen at each stop, to be drawn."""
from __future__ import annotations

from collections import Counter
from collections.abc import Sequence, Set
from contextlib import suppress
import math

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration, Reject, Sample
from handeye_ros.errors import UnusableMessageError
from handeye_ros.frames import in_mount
from handeye_ros.results.report.evidence import StopSnapshot
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.state import State
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


def late_sentence(kinds: Sequence[str]) -> str:
    """Return what is wrong where messages (poses, profiles) are older than those before."""
    return (f'{" and ".join(kinds)} are dropped, as their stamps are older than those before: '
            'sampling continues by itself if the clock was set back')


def with_trouble(text: str, trouble: str) -> str:
    """Return a text, and what else a person should know who reads it."""
    return text if trouble in text else f'{text}; {trouble}'


def in_the_way(state: State, success: bool, service: str) -> str:
    """
    Return what else a person should know who reads the answer of a service.

    Silence is told where it explains a refusal as nothing ever came, and to who takes a sample.
    """
    takes = service == 'take_sample'
    streams = [stream.trouble for stream in (state.profiles, state.poses)
               if takes or not success and (
                   stream.count == 0 or stream.malformed > stream.count)]
    return '; '.join(filter(None, (*streams, state.session.trouble)))


def changes_since(solved: Set[int], now: Set[int]) -> str:
    """Return how the samples, by their stamps, differ from those of an answer, if they do."""
    removed, added = len(solved - now), len(now - solved)
    if not removed and not added:
        return ''
    what = ' and '.join([f'{removed} removed'] * bool(removed) + [f'{added} added'] * bool(added))
    return (f'; it was computed from {count_of(len(solved), "sample")}, which have changed since '
            f'({what}): call ~/compute_calibration for an answer from the {len(now)} of now')


def calibration_summary(calibration: Calibration) -> str:
    """Return the transform with its 1 sigma, and how well the samples agree."""
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
