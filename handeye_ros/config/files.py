"""ROS parameter files: those of this package, and dumps of a running node."""
from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from handeye_ros.config.keys import Config
from handeye_ros.config.values import with_values, yaml_content
from handeye_ros.errors import ConfigFileError, InputError
import yaml

NODE = 'handeye'  # the name of the node, and of its section in parameter files
EVERY_NODES = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
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
