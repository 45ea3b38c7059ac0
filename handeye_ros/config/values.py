# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Sets values of keys with their types; invalid ones raise."""
from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
import re
from typing import Any

from handeye_ros.config.keys import Config, parameters, RECORD, ROBOT_CLASSES
from handeye_ros.errors import BadValueError, InputError, UnknownKeyError
import yaml

LONGEST_TEXT = 1000  # characters of a record.*
DEEPEST = 100  # nesting of brackets in a YAML file
NODE = 'handeye'  # the name of the node, and of its section in parameter files
# Parameters of every ROS node, also in a dump of ours.
EVERY_NODES = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')


def with_values(config: Config, values: Mapping[str, Any], source: str = 'values') -> Config:
    """
    Return a configuration with values by dotted key, such as {'target.type': 'sphere'}.

    source: of the values, for the message. Raises UnknownKeyError and BadValueError.
    """
    known = [p.key for p in parameters()]
    robot = values.get('noise.robot_class')
    if robot in ROBOT_CLASSES:
        values = {'noise.robot_smooth': ROBOT_CLASSES[robot], **values}
    for key, value in values.items():
        if key.startswith(RECORD):
            config = _with_record(config, key, value)
            continue
        if key not in known:
            raise UnknownKeyError(key, known, source)
        config = _with_value(config, key.split('.'), value)
    return config


def from_provenance(values: Any) -> Config:
    """Return the configuration of a calibration file; unknown keys are ignored."""
    config, known = Config(), {p.key for p in parameters()}
    for key, value in values.items() if isinstance(values, Mapping) else ():
        if key in known or str(key).startswith(RECORD):
            try:
                config = with_values(config, {key: value}, 'the calibration')
            except BadValueError:
                continue  # written by a newer version
    return config


def with_assignments(config: Config, assignments: Iterable[str]) -> Config:
    """Return a configuration with `key=value` texts (values in YAML) applied."""
    for text in assignments:
        key, equals, value = text.partition('=')
        if not equals:
            raise InputError(f'"{text}" is not of the form key=value')
        try:
            parsed = yaml_content(value)
        except yaml.YAMLError as error:
            raise InputError(f'the value in "{text}" is not valid YAML') from error
        config = with_values(config, {key.strip(): parsed}, '--set')
    return config


def flipped_range(config: Config) -> Config:
    """Return the configuration with the opposite profile.range_sign."""
    return replace(config, profile=replace(config.profile, range_sign=-config.profile.range_sign))


def _with_record(config: Config, key: str, value: Any) -> Config:
    """Return a configuration with a free text of the record; an empty one removes it."""
    name, text = key.removeprefix(RECORD), '' if value is None else str(value)
    if not re.fullmatch(r'[A-Za-z]\w*', name):
        raise BadValueError(key, value, 'a name of letters, digits and _ after record.')
    if len(text) > LONGEST_TEXT or not text.isprintable():
        raise BadValueError(key, value, f'one line of at most {LONGEST_TEXT} characters')
    record = {**dict(config.record), name: text}
    return replace(config, record=tuple((n, t) for n, t in record.items() if t))


def _with_value(section: Any, names: list[str], value: Any) -> Any:
    if len(names) > 1:
        value = _with_value(getattr(section, names[0]), names[1:], value)
    return replace(section, **{names[0]: value})


def yaml_content(text: str) -> Any:
    """Return the content of a YAML text with plain values only; raises yaml.YAMLError."""
    # deep nesting would take the parser seconds
    depths = accumulate(1 if c in '[{' else -1 for c in re.findall(r'[\[{}\]]', text))
    if max(depths, default=0) > DEEPEST:
        raise yaml.YAMLError('it is nested too deeply')
    try:
        return yaml.safe_load(text)
    except ValueError as error:  # an invalid date or number
        raise yaml.YAMLError(str(error)) from error
    except RecursionError as error:
        raise yaml.YAMLError('it is nested too deeply') from error


def load(path: Path, config: Config | None = None) -> Config:
    """
    Return a configuration (default: the defaults) with the values of a ROS parameter file.

    Also of a dump of the node (`ros2 param dump`) with any name and namespace. Raises InputError.
    """
    try:
        content = yaml_content(path.read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f'cannot read the configuration {path}: {error}') from error
    except yaml.YAMLError as error:
        raise InputError(f'{path} is not valid YAML: {error}') from error
    return with_values(config or Config(), _node_values(content, path), str(path))


def _node_values(content: Any, path: Path) -> dict[str, Any]:
    """
    Return the dotted values of our node in a parameter file; raises InputError without any.

    The sections are the patterns for every node, and our node's name in any namespace. A node may
    have been renamed: the dump of one has nearly all keys, unlike the section of another node.
    """
    sections, known = dict(_sections(content, '')), {p.key for p in parameters()}
    general = [name for name in sections if name.split('/')[-1] in ('*', '**')]
    own = [name for name in sections if name.split('/')[-1] == NODE] or [
        name for name, found in sections.items() if 2 * len(known & found.keys()) > len(known)]
    if not sections:
        raise InputError(f'{path} holds no parameters of the node; expected the form of a ROS '
                         'parameter file: "/**:", below it "ros__parameters:", below it the keys')
    if len(own) > 1 or not own and not general:
        names = ', '.join(own or sections)
        raise InputError(f'{path} holds the parameters of {names}' + (
            f': keep those of one "{NODE}"' if own else f', and none of them is "{NODE}": give '
            'the calibration a section of that name, or "/**"'))
    values: dict[str, Any] = {}
    for name in dict.fromkeys([*general, *own]):
        values |= sections[name]
    return {key: value for key, value in values.items() if not key.startswith(EVERY_NODES)}


def _sections(content: Any, name: str) -> Iterable[tuple[str, dict[str, Any]]]:
    """Yield the full name of every node in a parameter file, and its dotted values."""
    for key, value in content.items() if isinstance(content, dict) else ():
        if key == 'ros__parameters' and isinstance(value, dict):
            yield name, _dotted(value, '')
        elif isinstance(value, dict):
            yield from _sections(value, f'{name}/{str(key).strip("/")}')


def _dotted(section: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name, value in section.items():
        if isinstance(value, dict):
            values |= _dotted(value, f'{prefix}{name}.')
        else:
            values[f'{prefix}{name}'] = value
    return values
