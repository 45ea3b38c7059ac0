"""Values put in for keys, in their types; what does not fit is refused."""
from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import accumulate
import math
from pathlib import Path
import re
from typing import Any

from handeye_ros.config.cell import ROBOT_CLASSES
from handeye_ros.config.keys import Config, parameters, RECORD
from handeye_ros.config.parameter import Parameter
from handeye_ros.errors import BadValueError, ConfigFileError, InputError, UnknownKeyError
import yaml

LONGEST_TEXT = 1000  # characters of a record.*
DEEPEST = 100  # nesting of brackets in a YAML file
NODE = 'handeye'  # the name of the node, and of its section in parameter files
EVERY_NODES = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')


def with_values(config: Config, values: Mapping[str, Any], source: str) -> Config:
    """
    Return config with values by dotted key put in.

    source: what the values come from, for the message.
    Raises UnknownKeyError and BadValueError.
    """
    known = {p.key: p for p in parameters()}
    robot = values.get('noise.robot_class')
    if robot in ROBOT_CLASSES:
        values = {'noise.robot_smooth': ROBOT_CLASSES[robot], **values}
    for key, value in values.items():
        if key.startswith(RECORD):
            config = _with_record(config, key, value)
            continue
        if key not in known:
            raise UnknownKeyError(key, list(known), source)
        config = _put(config, key.split('.'), _checked(known[key], value))
    return config


def from_provenance(values: Any) -> Config:
    """Return the configuration that a file tells of; what is not known here is left out."""
    config, known = Config(), {p.key for p in parameters()}
    for key, value in values.items() if isinstance(values, Mapping) else ():
        if key in known or str(key).startswith(RECORD):
            try:
                config = with_values(config, {key: value}, 'the calibration')
            except BadValueError:
                continue  # written by a version that knew more
    return config


def with_assignments(config: Config, assignments: Iterable[str]) -> Config:
    """Return config with `key=value` texts (values in YAML) put in."""
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
    """Return the configuration with profile.range_sign the other way."""
    return replace(config, profile=replace(config.profile, range_sign=-config.profile.range_sign))


def _with_record(config: Config, key: str, value: Any) -> Config:
    """Return config with a free text put in; an empty one takes it away."""
    name, text = key.removeprefix(RECORD), '' if value is None else str(value)
    if not re.fullmatch(r'[A-Za-z]\w*', name):
        raise BadValueError(key, value, 'a name of letters, digits and _ after record.')
    if len(text) > LONGEST_TEXT or not text.isprintable():
        raise BadValueError(key, value, f'one line of at most {LONGEST_TEXT} characters')
    kept = {**dict(config.record), name: text}
    return replace(config, record=tuple((n, t) for n, t in kept.items() if t))


def _put(part: Any, names: list[str], value: Any) -> Any:
    if len(names) > 1:
        value = _put(getattr(part, names[0]), names[1:], value)
    return replace(part, **{names[0]: value})


def _checked(parameter: Parameter, value: Any) -> Any:
    """Return the value in the type of the parameter's default, or raise BadValueError."""
    if isinstance(parameter.default, tuple):
        return _checked_list(parameter, [] if value is None else value)
    kind = type(parameter.default)
    if value is None and kind is str:
        value = ''
    elif kind is float:
        value = _number(value)
    if type(value) is not kind or (kind is float and not math.isfinite(value)):
        raise BadValueError(parameter.key, value, f'a value of type {kind.__name__}')
    if kind is str:
        _check_text(parameter, value)
    _check_limits(parameter, value)
    return value


def _number(value: Any) -> Any:
    """Return a whole number, or a text such as 3e-5 (to YAML no number), as a float."""
    try:
        return float(value) if type(value) in (int, str) else value
    except ValueError:
        return value


def _check_text(parameter: Parameter, value: str) -> None:
    """Refuse texts that nobody can read, and empty ones where a name is needed."""
    if not value.isprintable() or value != value.strip():
        raise BadValueError(parameter.key, value,
                            'a text without control characters, or blanks around it')
    if parameter.default and not value:
        raise BadValueError(parameter.key, value, f'a text such as {parameter.default}')


def _checked_list(parameter: Parameter, value: Any) -> tuple[Any, ...]:
    if (not isinstance(value, list | tuple)
            or parameter.length and len(value) not in parameter.length):
        lengths = ' or '.join(map(str, parameter.length)) or 'any number of'
        raise BadValueError(parameter.key, value, f'a list of {lengths} values')
    if parameter.whole:
        if any(type(item) is not int for item in value):
            raise BadValueError(parameter.key, value, 'a list of whole numbers')
    elif not parameter.choices:
        value = [_number(item) for item in value]
        for item in value:
            if type(item) not in (int, float) or not math.isfinite(item):
                raise BadValueError(parameter.key, value, 'a list of numbers')
    for item in value:
        _check_limits(parameter, item)
    if parameter.key == 'profile.axes' and value[0][-1] == value[1][-1]:
        raise BadValueError(parameter.key, list(value), 'two different axes')
    return tuple(value)


def _check_limits(parameter: Parameter, value: Any) -> None:
    if parameter.choices and value not in parameter.choices:
        expected = 'one of ' + ', '.join(map(str, parameter.choices))
        raise BadValueError(parameter.key, value, expected)
    low, high = parameter.minimum, parameter.maximum
    if low is not None and high is not None and not low <= value <= high:
        raise BadValueError(parameter.key, value,
                            f'a number from {low:g} to {high:g} {parameter.unit}'.rstrip())


def yaml_content(text: str) -> Any:
    """Return what a YAML text holds, of plain values alone; raises yaml.YAMLError."""
    # the parser takes seconds for what nobody writes, before it gives up
    depths = accumulate(1 if c in '[{' else -1 for c in re.findall(r'[\[{}\]]', text))
    if max(depths, default=0) > DEEPEST:
        raise yaml.YAMLError('it is nested too deeply')
    try:
        return yaml.safe_load(text)
    except ValueError as error:  # a date or a number that is none
        raise yaml.YAMLError(str(error)) from error
    except RecursionError as error:
        raise yaml.YAMLError('it is nested too deeply') from error


"""Parameters that every ROS node has, and so a dump of ours: no keys of this package."""


def load(path: Path, config: Config | None = None) -> Config:
    """
    Return config (default: the defaults) with the values of a ROS parameter file put in.

    Files for the node do, and dumps of it (`ros2 param dump`), whatever its name and namespace.
    Raises InputError.
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
    Return the dotted values of our node in a parameter file; raises ConfigFileError.

    They stand below the patterns that fit every node, and below our node's name, in any
    namespace; or below the only name there is, for a node can be given another.
    """
    sections = dict(_sections(content, ''))
    general = [name for name in sections if name.split('/')[-1] in ('*', '**')]
    named = [name for name in sections if name not in general]
    ours = [name for name in named if name.split('/')[-1] == NODE] or named
    if len(ours) > 1 or not sections:
        raise ConfigFileError(path, ours)
    values: dict[str, Any] = {}
    for name in (*general, *ours):
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
