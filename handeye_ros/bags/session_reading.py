"""
A session on the disk: the content of its files, and reading them.

Each file holds profiles and poses (and joint values), and an event with the settings as JSON in
messages of type String. Stops that are read are evaluated again.
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import partial
import json
from pathlib import Path
from typing import Any, TYPE_CHECKING

from handeye_ros.bags.bag import read_poses
from handeye_ros.bags.messages import pose_from_cdr, ProfileReader, text_from_cdr
from handeye_ros.bags.reader import CLOUD, POSE, Raw
from handeye_ros.bags.session_files import BagFile, files_of, read_file
from handeye_ros.config import Config, flatten, with_values
from handeye_ros.data import Array, Feature, Reject
from handeye_ros.errors import BagError, SessionError, UnusableMessageError
from handeye_ros.robot.model import Arm, Chain
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import judged, Outcome, Seen, Stop
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from handeye_ros.robot.samples import Source

LAST = 'last'

FORMAT = 'handeye_ros/session/'
NEWEST = 1

CONFIGURATION = '/handeye_ros/session/configuration'
OUTCOME = '/handeye_ros/session/outcome'
FEATURES = '/handeye_ros/session/features'

STOP, REMOVED, CONFIGURED = 'stop', 'removed', 'configured'  # kinds of events


@dataclass(frozen=True)
class Event:
    """
    An event: a stop was evaluated, a sample was removed, or the settings were changed.

    number: of the stop, 0 for settings; began: stamp of its first pose; taken: whether it gave a
    sample; text: why there is no sample; refused: why its sample is never used.
    """

    kind: str
    config: Config
    number: int = 0
    began: int = 0
    taken: bool = False
    text: str = ''
    refused: str = ''


def texts_of(event: Event, outcome: Outcome | None) -> dict[str, str]:
    """Return the JSON texts of an event by topic."""
    values: dict[str, Any] = {
        'event': event.kind, 'number': event.number, 'began': event.began, 'taken': event.taken,
        'text': event.text, 'refused': event.refused}
    texts: dict[str, dict[str, Any]] = {
        CONFIGURATION: {'config': flatten(replace(event.config, session=''))}, OUTCOME: values}
    if outcome and outcome.sample:
        sample = outcome.sample
        values |= {'stamp': sample.stamp, 'profiles': sample.profiles,
                   'T_base_flange': sample.T_base_flange.tolist()}
        texts[FEATURES] = {'number': event.number,
                           'features': [_plain(feature) for feature in sample.features]}
    return {topic: json.dumps({'format': f'{FORMAT}{NEWEST}', **content})
            for topic, content in texts.items()}


def _plain(feature: Feature) -> dict[str, Any]:
    """Return a feature as plain values, without its raw points."""
    values = {item.name: getattr(feature, item.name) for item in fields(feature)
              if item.name != 'raw'}
    return {'type': type(feature).__name__} | {
        name: value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        for name, value in values.items()}


def event_of(configuration: str, outcome: str, path: object) -> Event:
    """Return the event of two JSON texts; path: for errors. Raises SessionError."""
    config = _content(configuration, path).get('config')
    values = _content(outcome, path)
    if not isinstance(config, dict):
        raise SessionError(path, 'holds no configuration')
    defaults = flatten(Config())
    config = {key: value for key, value in config.items() if key in defaults}
    try:
        return Event(str(values['event']), with_values(Config(), config, str(path)),
                     int(values['number']), int(values['began']), bool(values['taken']),
                     str(values['text']), str(values['refused']))
    except (KeyError, TypeError, ValueError) as error:
        raise SessionError(path, f'holds an event that is not understood ({error!r})') from error


def _content(text: str, path: object) -> Mapping[str, Any]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SessionError(path, f'holds a record that is no JSON ({error})') from error
    form = content.get('format') if isinstance(content, dict) else None
    number = str(form).removeprefix(FORMAT)
    if not number.isdecimal() or str(form) == number:
        raise SessionError(path, f'is of the format "{form}", expected {FORMAT}{NEWEST}')
    if int(number) > NEWEST:
        raise SessionError(path, f'is of the format {form}, newer than this version of '
                           'handeye_ros knows: update the package')
    return dict(content)


@dataclass(frozen=True, eq=False)
class Stored:
    """
    A session on the disk.

    config: the last settings; stops: by number, without removed ones; numbers: the largest number
    so far; types: by topic.
    """

    path: Path
    config: Config
    stops: dict[int, tuple[Event, Stop]]
    numbers: int
    files: tuple[BagFile, ...]
    types: dict[str, str]

    def session(self, config: Config) -> Session:
        """Return the session, its stops evaluated with a configuration."""
        session = Session(config)
        frames = (profile.frame_id for _, stop in self.stops.values()
                  for profile in stop.load(config).profiles)
        outcomes = [judged(Outcome(number, stop, Reject(stop.began, ''), event.refused), config)
                    for number, (event, stop) in sorted(self.stops.items())]
        session.restore(outcomes, self.numbers, next(frames, ''))
        return session


def is_session(path: Path) -> bool:
    """Return whether a folder holds a session."""
    try:
        files = files_of(path) if path.is_dir() else []
        return bool(files) and OUTCOME in read_file(files[0], (OUTCOME,)).types
    except (OSError, BagError):
        return False


def sessions_in(folder: Path) -> Iterator[Path]:
    """Yield the sessions in the folder of a name, the newest first."""
    paths = sorted(folder.iterdir(), reverse=True) if folder.is_dir() else []
    return filter(is_session, paths)


def read_session(path: Path) -> Stored:
    """
    Return a session from its folder, even if metadata.yaml lacks the last file.

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
    texts = {raw.topic: text_from_cdr(raw.data) for raw in messages
             if raw.topic in (CONFIGURATION, OUTCOME)}
    if len(texts) < 2:
        raise SessionError(file, 'does not say what happened')
    return event_of(texts[CONFIGURATION], texts[OUTCOME], file)


def load(file: Path, config: Config) -> Seen:
    """Return poses and profiles of a stop from its file; raises BagError."""
    content = read_file(file)
    # log_time is the stamp that the node used: a driver may publish none
    offset = round(config.time_offset * 1e9)
    reader = ProfileReader(config.profile)
    poses, profiles = [], []
    for raw in content.messages:
        kind = content.types[raw.topic]
        if kind == POSE:
            poses.append(pose_from_cdr(raw.data))
        elif kind == CLOUD:
            with suppress(UnusableMessageError):  # it may be invalid with other settings
                profiles.append(replace(reader.take(raw.data), stamp=raw.log_time + offset))
    return Seen(tuple(poses), tuple(profiles))


def joints_of(path: Path, config: Config, chain: Chain) -> tuple[NDArray[np.int64], Array]:
    """Return stamps (n,) and joint values (n, joints); raises InputError without any."""
    recording = read_poses(path, replace(config, kinematics=''), Arm(chain))
    assert recording.joints is not None
    return np.array([pose.stamp for pose in recording.poses], dtype=np.int64), recording.joints


def source_of_session(stored: Stored, config: Config, chain: Chain) -> Source:
    """Return the samples of a session with their joint values; raises InputError."""
    from handeye_ros.checks.settings import require_same_clock
    from handeye_ros.robot.samples import Source  # both import the whole pipeline
    session = stored.session(config)
    return Source.of(session.samples, session.rejects, session.frame_id, config, chain,
                     *joints_of(stored.path, config, chain),
                     require_same_clock=partial(require_same_clock, session),
                     inputs=[{'path': str(stored.path)}], warnings=session.warnings)
