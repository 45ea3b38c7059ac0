"""What a session's bag holds besides profiles and poses: plain values, as JSON in String."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
import json
from typing import Any

from handeye_ros.config import Config, flatten, with_values
from handeye_ros.data import Feature
from handeye_ros.ros.errors import SessionError
from handeye_ros.sampling.stops import Outcome
import numpy as np

FORMAT = 'handeye_ros/session/'
NEWEST = 1

CONFIGURATION = '/handeye_ros/session/configuration'
OUTCOME = '/handeye_ros/session/outcome'
FEATURES = '/handeye_ros/session/features'

STOP, REMOVED, CONFIGURED = 'stop', 'removed', 'configured'  # what happened


@dataclass(frozen=True)
class Event:
    """
    What happened: a stop was judged, a sample was removed, or the settings were changed.

    number: of the stop, 0 for settings; began: the stamp of its first pose; taken: whether it
    gave a sample; text: what was seen or why there is none; refused: why its sample is none,
    whatever is extracted from it.
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
    """Return a feature as plain values, without the points that it was made of."""
    values = {item.name: getattr(feature, item.name) for item in fields(feature)
              if item.name != 'raw'}
    return {'type': type(feature).__name__} | {
        name: value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        for name, value in values.items()}


def event_of(configuration: str, outcome: str, path: object) -> Event:
    """Return the event that two texts describe; raises SessionError."""
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
