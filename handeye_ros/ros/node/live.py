"""
A session that is fed, asked and solved from different threads; what the node's services do.

Knows no ROS. The lock is held around the session alone, never while solving: a solve works
on a copy, in which the station that the robot stands in now counts as finished, so that the
answer is that of a recording that ends here.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
import os
from pathlib import Path
import threading
import time

from handeye_ros import pipeline
from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Calibration, Reject, Sample, TimedPose
from handeye_ros.errors import DataError, UnwritableError
from handeye_ros.results import calibration_file, exports
from handeye_ros.results.errors import NothingToSaveError
from handeye_ros.ros.node.wording import (
    calibration_summary,
    changes_since,
    count_of,
    late_sentence,
    sample_summary,
)
from handeye_ros.sampling.errors import ClearedError
from handeye_ros.sampling.session import Session


class Arrivals:
    """What has come in so far, for the diagnostics."""

    def __init__(self) -> None:
        """Start with nothing, now."""
        self.counts = Counter({'profile': 0, 'pose': 0, 'malformed': 0})
        self.last_malformed = ''
        self._malformed: Counter[str] = Counter()
        self._latest = dict.fromkeys(('profile', 'pose'), time.monotonic())

    def came(self, kind: str) -> None:
        """Count a good message."""
        self.counts[kind] += 1
        self._latest[kind] = time.monotonic()

    def malformed(self, kind: str, reason: str) -> None:
        """Count a message that could not be understood."""
        self.counts['malformed'] += 1
        self._malformed[kind] += 1
        self.last_malformed = reason

    @property
    def mostly_malformed(self) -> str:
        """Return which messages cannot be understood, if that is most of a kind, and why."""
        bad = [f'{self._malformed[kind]} of {self._malformed[kind] + self.counts[kind]} {kind}s'
               for kind in ('profile', 'pose') if self._malformed[kind] > self.counts[kind]]
        return (f'{" and ".join(bad)} cannot be used; the last reason: {self.last_malformed}'
                if bad else '')

    def silence(self, kind: str) -> float:
        """Return the seconds since the last good message, or since the start."""
        return time.monotonic() - self._latest[kind]


class LiveSession:
    """The samples of a running node, and the last answer."""

    def __init__(self, config: Config) -> None:
        """Start without samples; raises BadValueError for a method that does not exist."""
        self._lock = threading.Lock()
        self._session = Session(config)
        self._calibration: Calibration | None = None
        self._solved: frozenset[int] = frozenset()  # stamps of the samples of the calibration
        self._cleared = 0  # how often
        self.is_solving = False
        self.config = config
        self.arrivals = Arrivals()
        self.last_refusal = ''

    @property
    def samples(self) -> tuple[Sample, ...]:
        """Return the samples taken so far."""
        with self._lock:
            return self._session.samples

    @property
    def frame_id(self) -> str:
        """Return the frame of the profiles, empty before the first."""
        with self._lock:
            return self._session.frame_id

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return what was dropped, one sentence each."""
        with self._lock:
            return self._session.warnings

    @property
    def trouble(self) -> str:
        """Return why what comes in now is of no use, and what to do; empty if it is."""
        with self._lock:
            conflict, late = self._session.conflict, self._session.late
        found = (self.arrivals.mostly_malformed, str(conflict or ''),
                 late_sentence(late) if late else '')
        return '; '.join(filter(None, found))

    @property
    def calibration(self) -> Calibration | None:
        """Return the last answer that was not refused."""
        return self._calibration

    def configure(self, config: Config) -> None:
        """Go on with another configuration, already checked by params.changed."""
        with self._lock:
            if _differs(config, self.config):
                self._session = Session(config)
            self._session.configure(config)
            self.config = config

    def add_profile(self, profile: AnyProfile) -> list[Sample | Reject]:
        """Take a profile; return what became of the stations that are now over."""
        self.arrivals.came('profile')
        with self._lock:
            self._session.add_profile(profile)
            return self._noted(self._session.collect())

    def add_poses(self, poses: Iterable[TimedPose]) -> list[Sample | Reject]:
        """Take poses; return what became of the stations that are now over."""
        with self._lock:
            for pose in poses:
                self.arrivals.came('pose')
                self._session.add_pose(pose)
            return self._noted(self._session.collect())

    def _noted(self, outcomes: list[Sample | Reject]) -> list[Sample | Reject]:
        for outcome in outcomes:
            if isinstance(outcome, Reject):
                self.last_refusal = outcome.reason
        return outcomes

    def take_sample(self) -> tuple[Sample, str]:
        """Return a sample of where the robot stands, and what to say; raises DataError."""
        with self._lock:
            before = len(self._session.samples)
            sample = self._session.take_sample()
            count = len(self._session.samples)
        again = ' again, as the robot has not moved since' if count == before else ''
        return sample, f'sample {count} taken{again}: {sample_summary(sample)}'

    def remove_last_sample(self) -> str:
        """Forget the last sample; raises DataError when there is none."""
        with self._lock:
            removed = self._session.remove_last().result
            count = len(self._session.samples)
        return f'removed the last sample ({sample_summary(removed)}); {count} left'

    def clear_samples(self) -> str:
        """Forget all samples, the answer, and all that was received."""
        with self._lock:
            count = len(self._session.samples)
            self._session.clear()
            self._cleared += 1
            self._calibration = None
        return f'{count_of(count, "sample")} removed; bags and clocks may start again'

    def compute(self) -> tuple[Calibration, str]:
        """
        Return the answer from all samples, and what to say.

        Raises DataError when there is none, or InputError; the answer before is then gone.

        """
        with self._lock:
            session, config, cleared = self._session.copied(), self.config, self._cleared
            self._calibration = None
        session.finish()
        session.require_stations()
        self.is_solving = True
        try:
            found = pipeline.solve(session.samples, session.rejects, config, session.frame_id)
        finally:
            self.is_solving = False
        inputs = [{'topic': config.profile_topic},
                  {'topic': config.pose_topic if config.pose_source == 'topic' else '/tf'}]
        found = replace(found, provenance={**found.provenance, 'inputs': inputs})
        with self._lock:
            if self._cleared != cleared:
                raise ClearedError
            self._calibration, self._solved = found, _stamps(session)
        return found, calibration_summary(found)

    def save(self) -> str:
        """Write the last answer; raises NothingToSaveError, and InputError if it cannot."""
        with self._lock:
            calibration, solved, session = self._calibration, self._solved, self._session.copied()
        if calibration is None:
            raise NothingToSaveError
        name = calibration_file.folder_name(self.config)
        saved = exports.save_all(replace(calibration, name=name), self._parent_folder() / name,
                                 self.config.save.formats)
        with suppress(DataError):
            session.finish()
        return f'{saved}{changes_since(solved, _stamps(session))}'

    def _parent_folder(self) -> Path:
        """Return what is above the folder of this calibration, as an absolute path."""
        home = os.environ.get('ROS_HOME') or '~/.ros'
        parent = Path(self.config.output_dir or f'{home}/handeye')
        try:
            return parent.expanduser().absolute()
        except RuntimeError as error:
            raise UnwritableError(parent, str(error)) from error


def _stamps(session: Session) -> frozenset[int]:
    """Return what tells the samples of a session apart."""
    return frozenset(sample.stamp for sample in session.samples)


def _differs(config: Config, other: Config) -> bool:
    """Tell whether two configurations take other samples."""
    same = replace(config, name=other.name, limits=other.limits, save=other.save,
                   samples=other.samples,
                   sampling=replace(config.sampling, mode=other.sampling.mode))
    return same != other
