# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A session on the disk: written event by event, and read back.

A session is a folder, and a bag: one .mcap file for each event, which holds the settings and, for
a stop, its profiles and poses (and joint values), so that stops can be evaluated again. A file is
written under another name, synced, renamed, and the folder is synced; then the event is reported.
If the process is killed at any time, all files are complete bags: a hidden .tmp file may be left,
and is ignored (of the first event also a folder without events, which is no session); a stop that
was renamed, but not yet reported, counts. metadata.yaml, for other readers of bags, repeats only
data of the files: it may lack the last one after a failure, and is written again with the next
event, and when the session is continued.
"""
from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
import fcntl
from functools import partial
import json
import os
from pathlib import Path
import re
import shutil
import time

from handeye_ros.bags.messages import message_of, pose_from_cdr, ProfileReader
from handeye_ros.bags.storage import (
    by_log_time,
    CLOUD_TYPE,
    full_name,
    JOINTS_TYPE,
    POSE_TYPE,
    Reader,
    RecordedMessage,
    STRING_TYPE,
)
from handeye_ros.bags.writer import (
    recorded_message,
    string_cdr,
    summary_of,
    sync,
    write_mcap,
    write_metadata,
)
from handeye_ros.config import Config, flatten, RECORD_PREFIX, with_values
from handeye_ros.data import Reject
from handeye_ros.errors import InputError, UnusableMessageError
from handeye_ros.output import atomic_file, folder_time, write_errors_for
from handeye_ros.results.file_values import require_format
from handeye_ros.sampling.features import result_of
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import NO_STOP, NOT_EVALUATED, Stop

FORMAT = 'handeye_ros/session/1'
CONFIGURATION_TOPIC = '/handeye_ros/session/configuration'
OUTCOME_TOPIC = '/handeye_ros/session/outcome'
STOP, REMOVED, CONFIGURED = 'stop', 'removed', 'configured'  # events

SUFFIX, LOCK_FILE = '.mcap', '.lock'


@dataclass(frozen=True, eq=False)
class StoredSession:
    """
    A session on the disk.

    path: its folder
    config: the last settings
    stops: by number, without removed ones; NOT_EVALUATED is the result of those that gave a sample
    last_number: the largest number of a stop so far, also of a removed one
    """

    path: Path
    config: Config
    stops: dict[int, Stop]
    last_number: int

    @property
    def sample_count(self) -> int:
        """Return how many of the stops gave a sample."""
        return sum(stop.result is NOT_EVALUATED for stop in self.stops.values())

    def session(self, config: Config) -> Session:
        """
        Return the session with its stops evaluated by a configuration.

        Raises InputError for a file of a stop that cannot be read.
        """
        pose_frames = (pose.parent_frame for stop in self.stops.values()
                       for pose in stop.load(config).poses)
        profile_frames = (profile.frame_id for stop in self.stops.values()
                          for profile in stop.load(config).profiles)
        session = Session(config, self.last_number,
                          (next(pose_frames, None), next(profile_frames, None)))
        for _, stored in sorted(self.stops.items()):
            stop = stored if stored.final_reason else replace(
                stored, result=result_of(stored, config))
            session.add_stop(session.with_result(stop, stop.result))
            session.mark_done(stop)
        return session


class SessionFiles:
    """
    Writes one session; an event is on the disk when its method returns.

    path: the folder of the session, None before the first event. Not for several threads at once.
    """

    def __init__(self, folder_of: Callable[[Config], Path], stored: StoredSession | None = None,
                 config: Config | None = None) -> None:
        """
        Begin with the first event, or continue a session.

        folder_of: returns the folder that holds the folders of sessions; config: the settings from
        now on, which are written if they differ. Raises InputError for a session that another node
        has open, UnwritableError.
        """
        self._folder_of = folder_of
        self.path = stored.path if stored else None
        self._lock: int | None = None
        if stored:
            with write_errors_for(stored.path):
                self._lock = lock_folder(
                    stored.path, f'{stored.path} is in use by another node: end that node first, '
                    'or begin a new session')
            _write_metadata(stored.path)
            if config and replace(stored.config, session=config.session) != config:
                try:
                    self.add_event(CONFIGURED, config)
                except InputError:
                    self.close()
                    raise

    def close(self) -> None:
        """Release the lock, so that another node can continue the session."""
        if self._lock is not None:
            os.close(self._lock)
        self._lock = None

    def discard(self) -> None:
        """Release a session that could not be begun, and remove its folder."""
        self.close()
        if self.path:
            shutil.rmtree(self.path, ignore_errors=True)

    def add_stop(self, stop: Stop, config: Config, joints: Sequence[tuple[int, bytes]] = ()
                 ) -> Stop:
        """
        Write an evaluated stop; return it as it is on the disk.

        joints: stamps (ns) and serialised JointState messages, of which those during the stop are
        written. Raises UnwritableError.
        """
        loaded = stop.load(config)
        joints = [(stamp, data) for stamp, data in joints if loaded.start <= stamp <= loaded.end]
        file = self.add_event(STOP, config, loaded, joints)
        return replace(stop, poses=stop.poses[-1:], profiles=(),
                       load_messages=partial(load_stop, file, stop.stamp))

    def add_event(self, event: str, config: Config, stop: Stop = NO_STOP,
                  joints: Sequence[tuple[int, bytes]] = ()) -> Path:
        """
        Write an event into a file of its own, and sync it; return the file.

        event: STOP, for a stop that was evaluated, with what was seen there; REMOVED, for its
        sample, with its number; CONFIGURED, for new settings. Raises UnwritableError.
        """
        if self.path is None:
            where = f'a folder of the session in {self._folder_of(config)} (output_dir)'
            with write_errors_for(where):
                self.path, self._lock = self._make_folder(config)
        folder = self.path
        with write_errors_for(folder):
            if not folder.is_dir():
                raise FileNotFoundError('its folder is gone (unmounted or removed?); bring it '
                                        'back, or call ~/clear_samples for a new session')
            number = 1 + max(map(_number_of, files_of(folder)), default=-1)
            file = folder / f'{folder.name}_{number}{SUFFIX}'
            with atomic_file(file) as temporary, temporary.open('wb') as stream:
                write_mcap(stream, _messages(event, config, stop, joints))
                stream.flush()
                os.fsync(stream.fileno())
            sync(folder)
        _write_metadata(folder)
        return file

    def _make_folder(self, config: Config) -> tuple[Path, int]:
        """Make the folder of a new session, named after the time; return it and its lock."""
        folder = self._folder_of(config) / folder_time()
        missing = [above for above in folder.parents if not above.exists()]
        folder.mkdir(parents=True)
        for created in (folder, *missing):
            sync(created.parent)
        return folder, lock_folder(folder, f'another node has begun {folder}')


def _write_metadata(folder: Path) -> None:
    with suppress(OSError, InputError):  # it only repeats the files
        write_metadata(folder, files_of(folder))


def lock_folder(folder: Path, refusal: str) -> int:
    """
    Lock a folder until the process ends; return the file descriptor that holds the lock.

    Raises InputError with the sentence refusal if another process has locked the folder, and
    OSError if it cannot be locked.
    """
    lock = os.open(folder / LOCK_FILE, os.O_RDONLY | os.O_CREAT, 0o644)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(lock)
        raise InputError(refusal) from error
    return lock


def _messages(event: str, config: Config, stop: Stop, joints: Sequence[tuple[int, bytes]]
              ) -> list[RecordedMessage]:
    """Return the messages of an event, in the order of their times."""
    # a driver may publish no stamp: the time of the record holds it
    profiles = [replace(profile, stamp=profile.stamp - config.offset_ns)
                for profile in stop.profiles]
    messages = [recorded_message(item, config, 'f8') for item in (*stop.poses, *profiles)]
    messages += [RecordedMessage(full_name(config.joint_topic), JOINTS_TYPE, *joint)
                 for joint in joints]
    settings = {'config': flatten(replace(config, session=''))}
    outcome = {'event': event, 'number': stop.number, 'began': stop.stamp,
               'taken': stop.sample is not None, 'refused': stop.final_reason,
               'untimed': stop.untimed}
    end = stop.end if stop.poses else time.time_ns()
    for topic, content in ((CONFIGURATION_TOPIC, settings), (OUTCOME_TOPIC, outcome)):
        text = json.dumps({'format': FORMAT, **content})
        messages.append(RecordedMessage(topic, STRING_TYPE, end, string_cdr(text)))
    return sorted(messages, key=by_log_time)


def _number_of(file: Path) -> int:
    """Return the number of a file of a session, -1 for a file that is none."""
    match = re.search(rf'_(\d+){re.escape(SUFFIX)}$', file.name)
    return int(match[1]) if match and not file.name.startswith('.') else -1


def files_of(folder: Path) -> list[Path]:
    """Return the files of a session in the order of their numbers; raises OSError."""
    return sorted((path for path in folder.iterdir() if _number_of(path) >= 0), key=_number_of)


def is_session(path: Path) -> bool:
    """Return whether a folder holds a session: one of its files can be read as an event."""
    with suppress(OSError, ValueError):  # no folder, no name of one
        for file in files_of(path):
            with suppress(InputError):  # damaged
                channels = summary_of(file).channels
                return any(channel.topic == OUTCOME_TOPIC for channel in channels.values())
    return False


def sessions_in(folder: Path) -> Iterator[Path]:
    """Yield the folders of the sessions in a folder, the last used one first."""
    return filter(is_session, sorted(folder.glob('*'), key=last_use, reverse=True))


def last_use(session: Path) -> tuple[int, str]:
    """Return when a session was last begun, continued or written (ns), and the folder's name."""
    with suppress(OSError):  # it is gone
        return session.stat().st_mtime_ns, session.name
    return 0, session.name


def read_session(path: Path) -> StoredSession:
    """
    Return a session from its folder, even if metadata.yaml lacks the last file.

    Raises InputError.
    """
    if not is_session(path):
        raise InputError(f'{path} is no session: expected a folder that the node made')
    stops: dict[int, Stop] = {}
    last_number, config = 0, Config()
    for file in files_of(path):
        event, config, stop = _event_of(file)
        last_number = max(last_number, stop.number)
        if event == STOP:
            stops[stop.number] = stop
        elif event == REMOVED:
            stops.pop(stop.number, None)
    return StoredSession(path, config, stops, last_number)


def load_stop(file: Path, stamp: int, config: Config) -> Stop:
    """
    Return the poses and profiles of a stop from its file, as a stop without number and result.

    Profiles that cannot be read with other settings are dropped. Raises InputError.
    """
    offset = config.offset_ns
    reader = ProfileReader(config.profile)
    poses, profiles = [], []
    for message in _read_file(file):
        if message.message_type == POSE_TYPE:
            poses.append(pose_from_cdr(message.data))
        elif message.message_type == CLOUD_TYPE:
            with suppress(UnusableMessageError):
                profiles.append(replace(reader.take(message.data),
                                        stamp=message.log_time + offset))
    return Stop(stamp, tuple(poses), tuple(profiles))


def _read_file(file: Path, topics: Collection[str] | None = None) -> list[RecordedMessage]:
    """Return the messages of some topics, or of all, of a whole file; raises InputError."""
    reader = Reader(file, topics)
    messages = list(reader.messages())
    if reader.warnings:
        raise InputError(f'{file}: is damaged: {"; ".join(reader.warnings)}; without this file, '
                         'moved elsewhere, the session goes on with the others')
    return messages


def _event_of(file: Path) -> tuple[str, Config, Stop]:
    """Return the event in a file, the settings and the stop; raises InputError."""
    texts = {raw.topic: message_of(STRING_TYPE, raw.data).data
             for raw in _read_file(file, (CONFIGURATION_TOPIC, OUTCOME_TOPIC))}
    try:
        outcome = json.loads(texts[OUTCOME_TOPIC])
        configuration = json.loads(texts[CONFIGURATION_TOPIC])
        for content in (outcome, configuration):
            require_format(file, content['format'], FORMAT)
        known_keys = flatten(Config())
        settings = {key: value for key, value in configuration['config'].items()
                    # those of older versions may be gone; a value that is none any more is
                    # refused: with the default instead, the stops would show something else
                    if key in known_keys or key.startswith(RECORD_PREFIX)}
        stamp, refusal = int(outcome['began']), str(outcome['refused'])
        stop = Stop(stamp, load_messages=partial(load_stop, file, stamp),
                    # not in files of older versions
                    untimed=bool(outcome.get('untimed')), number=int(outcome['number']),
                    result=NOT_EVALUATED if outcome['taken'] else
                    Reject(stamp, refusal, final=bool(refusal)))
        return str(outcome['event']), with_values(Config(), settings, str(file)), stop
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise InputError(f'{file} holds an event that is not understood ({error!r})') from error
