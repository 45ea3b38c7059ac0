"""A session read back from its folder: its stops, to be judged again, and its settings."""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from handeye_ros.config import Config
from handeye_ros.data import Reject
from handeye_ros.errors import BagError
from handeye_ros.ros.bags.contents import CLOUD, POSE, Raw, STRING
from handeye_ros.ros.bags.messages import deserialised, pose_from_cdr
from handeye_ros.ros.bags.profile_reader import ProfileReader
from handeye_ros.ros.errors import MessageError, SessionError
from handeye_ros.ros.sessions.bag_files import BagFile, files_of, read_file
from handeye_ros.ros.sessions.records import (
    CONFIGURATION,
    Event,
    event_of,
    OUTCOME,
    REMOVED,
    STOP,
)
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import judged, Outcome, Seen, Stop

LAST = 'last'


@dataclass(frozen=True, eq=False)
class Stored:
    """
    A session as it lies in its folder.

    config: the last one; stops: by number, those that were not removed; numbers: the last one
    given; files: all of it.
    """

    path: Path
    config: Config
    stops: dict[int, tuple[Event, Stop]]
    numbers: int
    files: tuple[BagFile, ...]
    types: dict[str, str]

    def outcomes(self, config: Config) -> Iterator[Outcome]:
        """Yield what becomes of the stops with a configuration, in the order of their numbers."""
        for number, (event, stop) in sorted(self.stops.items()):
            yield judged(Outcome(number, stop, Reject(stop.began, ''), event.refused), config)

    def session(self, config: Config) -> Session:
        """Return the session, to be solved or to go on with."""
        session = Session(config)
        frames = (profile.frame_id for _, stop in self.stops.values()
                  for profile in stop.load(config).profiles)
        session.restore(list(self.outcomes(config)), self.numbers, next(frames, ''))
        return session


def is_session(path: Path) -> bool:
    """Tell whether a folder holds a session."""
    try:
        files = files_of(path) if path.is_dir() else []
        return bool(files) and OUTCOME in read_file(files[0], (OUTCOME,)).types
    except (OSError, BagError):
        return False


def last_session(parent: Path) -> Path | None:
    """Return the newest session below the folder of a name, None if there is none."""
    folders = sorted((path for path in parent.iterdir() if path.is_dir()), reverse=True
                     ) if parent.is_dir() else []
    return next((folder for folder in folders if is_session(folder)), None)


def read_session(path: Path) -> Stored:
    """
    Return a session from its folder, also where metadata.yaml lacks the last file.

    Raises SessionError or BagError.
    """
    if not is_session(path):
        raise SessionError(path, 'is no session: expected a folder that the node made')
    stops: dict[int, tuple[Event, Stop]] = {}
    described, types, numbers, config = [], dict[str, str](), 0, Config()
    for file in files_of(path):
        content = read_file(file, (CONFIGURATION, OUTCOME))
        event, types = _event(content.messages, file), types | content.types
        described.append(content.file)
        config, numbers = event.config, max(numbers, event.number)
        if event.kind == STOP:
            stops[event.number] = event, Stop(event.began, partial(load, file))
        elif event.kind == REMOVED:
            stops.pop(event.number, None)
    return Stored(path, config, stops, numbers, tuple(described), types)


def _event(messages: Sequence[Raw], file: Path) -> Event:
    texts = {raw.topic: deserialised(raw.data, STRING).data for raw in messages
             if raw.topic in (CONFIGURATION, OUTCOME)}
    if len(texts) < 2:
        raise SessionError(file, 'does not say what happened')
    return event_of(texts[CONFIGURATION], texts[OUTCOME], file)


def load(file: Path, config: Config) -> Seen:
    """Return what was seen at a stop, from its file; raises BagError."""
    content = read_file(file)
    # the time of receipt is the stamp that a profile had: a driver may send none
    offset = round(config.time_offset * 1e9)
    reader = ProfileReader(config.profile)
    poses, profiles = [], []
    for raw in content.messages:
        kind = content.types[raw.topic]
        if kind == POSE:
            poses.append(pose_from_cdr(raw.data))
        elif kind == CLOUD:
            with suppress(MessageError):  # other settings may not understand it
                profiles.append(replace(reader.take(raw.data), stamp=raw.log_time + offset))
    return Seen(tuple(poses), tuple(profiles))
