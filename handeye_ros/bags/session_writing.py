"""The store of a running node: an event is on the disk before a service reports it."""
from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, UTC
import fcntl
from functools import partial
import os
from pathlib import Path
import threading
import time
from typing import Any

from handeye_ros.bags.bag_write import cloud_cdr, pose_cdr, string_cdr
from handeye_ros.bags.reader import CLOUD, full_name, JOINTS, POSE, Raw, STRING
from handeye_ros.bags.session_files import (
    BagFile,
    METADATA,
    number_of,
    SUFFIX,
    sync,
    write_file,
    write_metadata,
)
from handeye_ros.bags.session_reading import (
    CONFIGURATION,
    CONFIGURED,
    Event,
    FEATURES,
    load,
    OUTCOME,
    REMOVED,
    STOP,
    Stored,
    texts_of,
)
from handeye_ros.bags.session_store import Store
from handeye_ros.config import Config
from handeye_ros.data import Profile
from handeye_ros.errors import SessionError, UnwritableError
from handeye_ros.sampling.stops import Outcome, Stop

STAMP = '%Y-%m-%dT%H%M%SZ'
LOCK = '.lock'


class SessionStore(Store):
    """
    Writes sessions, one after the other.

    parent: returns the folder that holds the folders of sessions.
    """

    def __init__(self, parent: Callable[[Config], Path], stored: Stored | None = None) -> None:
        """Begin with the first event, or continue a session; raises SessionError."""
        self._parent = parent
        self._folder: Path | None = stored.path if stored else None
        self._files: list[BagFile] = list(stored.files) if stored else []
        self._types: dict[str, str] = dict(stored.types) if stored else {}
        self._lock: int | None = None
        self._write_lock = threading.RLock()  # stops and settings are stored by different threads
        if stored:
            try:
                self._claim(stored.path)
                write_metadata(stored.path, self._files, self._types)
            except OSError as error:
                raise UnwritableError(stored.path, error.strerror or str(error)) from error

    @property
    def path(self) -> str:
        """Return the folder of the session, empty before there is one."""
        return str(self._folder or '')

    def close(self) -> None:
        """Release the lock, so that another node can continue the session."""
        if self._lock is not None:
            os.close(self._lock)
        self._lock = None

    def add(self, outcome: Outcome, config: Config) -> Outcome:
        """Write the outcome of a stop; return it with the stop on the disk. UnwritableError."""
        sample, stop = outcome.sample, outcome.stop
        text = outcome.result.reason if not sample else ''  # type: ignore[union-attr]
        event = Event(STOP, config, outcome.number, stop.began, sample is not None, text,
                      outcome.refused)
        file = self._append(event, config, outcome)
        return replace(outcome, stop=Stop(stop.began, partial(load, file)))

    def remove(self, number: int, config: Config) -> None:
        """Write that a sample was removed; raises UnwritableError."""
        if self._folder:
            self._append(Event(REMOVED, config, number), config)

    def configured(self, config: Config) -> None:
        """Write another configuration; raises UnwritableError."""
        if self._folder:
            self._append(Event(CONFIGURED, config), config)

    def sync(self) -> None:
        """Sync metadata.yaml; no service waits for it, as the files hold the same data."""
        if self._folder:
            with suppress(OSError):
                sync(self._folder / METADATA)

    def restart(self, config: Config) -> str:
        """Begin another session; return a note about the previous one; UnwritableError."""
        with self._write_lock:
            previous = self._folder, self._files, self._types, self._lock
            if not self._folder:
                return ''
            self._folder, self._files, self._types, self._lock = None, [], {}, None
            try:
                # the new session exists at once, so that `last` names it
                self._append(Event(CONFIGURED, config), config)
            except UnwritableError:
                self._folder, self._files, self._types, self._lock = previous
                raise
        if previous[3] is not None:
            os.close(previous[3])
        return f'; they are kept in {previous[0]}'

    def _append(self, event: Event, config: Config, outcome: Outcome | None = None) -> Path:
        path: object = self._folder or 'the folder of the session'
        try:
            with self._write_lock:
                folder = self._opened(config)
                path = folder
                if not folder.is_dir():
                    raise FileNotFoundError(
                        'its folder is gone (unmounted or removed?); bring it back, or call '
                        '~/clear_samples for a new session')
                return self._write(folder, event, config, outcome)
        except OSError as error:
            raise UnwritableError(path, error.strerror or str(error)) from error

    def _write(self, folder: Path, event: Event, config: Config, outcome: Outcome | None
               ) -> Path:
        types, messages = self._messages(event, config, outcome)
        number = 1 + max((number_of(file.name) for file in self._files), default=-1)
        path = folder / f'{folder.name}_{number}{SUFFIX}'
        written = write_file(path, messages, types)
        try:
            write_metadata(folder, [*self._files, written], self._types | types)
        except OSError:
            with suppress(OSError):
                path.unlink()  # the event is refused, so it must not be read back
            raise
        self._files.append(written)
        self._types |= types
        return path

    def _messages(self, event: Event, config: Config, outcome: Outcome | None
                  ) -> tuple[dict[str, str], list[Raw]]:
        """Return the types by topic and the messages of a file."""
        profiles = full_name(config.profile_topic)
        by_topic = config.pose_source == 'topic'
        poses = full_name(config.pose_topic if by_topic else 'flange_pose')
        types = {profiles: CLOUD, poses: POSE, CONFIGURATION: STRING, OUTCOME: STRING,
                 FEATURES: STRING}
        messages, end = [], time.time_ns()
        if outcome:
            recorded, offset = outcome.stop.load(config), round(config.time_offset * 1e9)
            messages += [Raw(poses, pose.stamp, pose_cdr(pose)) for pose in recorded.poses]
            messages += [Raw(profiles, profile.stamp - offset, _cloud(profile, config))
                         for profile in recorded.profiles]
            end = recorded.poses[-1].stamp
            if self.joints:
                joints = full_name(config.joint_topic)
                types[joints] = JOINTS
                messages += [Raw(joints, stamp, data)
                             for stamp, data in self.joints(recorded.poses[0].stamp, end)]
        messages += [Raw(topic, end, string_cdr(text))
                     for topic, text in texts_of(event, outcome).items()]
        return types, messages

    def _opened(self, config: Config) -> Path:
        """Return the folder of the session, created if necessary; raises OSError."""
        if self._folder is None:
            parent = self._parent(config)
            parent.mkdir(parents=True, exist_ok=True)
            folder = _new_folder(parent)
            sync(parent)
            self._claim(folder)
            self._folder = folder
        return self._folder

    def _claim(self, folder: Path) -> None:
        """Lock a session against other nodes; the lock ends with the process. SessionError."""
        lock = os.open(folder / LOCK, os.O_RDONLY | os.O_CREAT, 0o644)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(lock)
            raise SessionError(folder, 'is in use by another node: end that node first, or '
                                       'begin a new session') from error
        self._lock = lock


def _new_folder(parent: Path) -> Path:
    """Make a folder named after the time; raises OSError."""
    stamp = datetime.now(UTC).strftime(STAMP)
    for attempt in range(1000):
        folder = parent / (f'{stamp}-{attempt}' if attempt else stamp)
        with suppress(FileExistsError):
            folder.mkdir()
            return folder
    raise FileExistsError(f'{parent / stamp} is there already')


def _cloud(profile: Any, config: Config) -> bytes:
    """Return the message of a profile as received, or in the layout of a driver."""
    fetch = getattr(profile, 'fetch', None)
    if fetch:
        return bytes(fetch())
    assert isinstance(profile, Profile)
    return cloud_cdr(profile, config)
