# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The parameters of the node: those of config/, with their descriptions and ranges.

`ros2 param describe /handeye noise.sensor` prints them. Types are dynamic, so that 3 is accepted
for 3.0; config/ checks every value.
"""
from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from handeye_ros import config as configuration
from handeye_ros.bags.session import OutputFolders, resumed, SOURCE, Stored
from handeye_ros.config import Config, EVERY_NODES, Parameter, RECORD, RECORD_NAMES
from handeye_ros.errors import InputError, UnknownKeyError
from handeye_ros.output import folder_name
from handeye_ros.sampling.session import Session
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

# Keys that cannot change while the node runs.
FIXED = ('robot_base_frame', 'robot_effector_frame', 'session', 'page.port', 'page.address')
# Keys of targets that are solved from files alone.
FILES_ONLY = ('tracker.', 'sensor_frame')


def declare(node: Node, folders: OutputFolders) -> tuple[Config, Stored | None]:
    """
    Declare all parameters; return the configuration and the session to continue.

    Raises UnknownKeyError and BadValueError for the user's settings, InputError for a session that
    cannot be read.
    """
    # rclpy offers no other access to the values of parameter files and arguments
    config, stored = resumed(_values(node._parameter_overrides.values()), folders)
    _check_names(config)
    values, record = configuration.flatten(config), dict(config.record)
    described = {p.key: (values[p.key], _descriptor(p)) for p in _parameters()}
    free = ParameterDescriptor(description='Free text, kept with the answer.', dynamic_typing=True)
    described |= {f'{RECORD}{name}': (record.get(name, ''), free)
                  for name in (*RECORD_NAMES, *record)}
    for key, (value, descriptor) in described.items():
        node.declare_parameter(key, value, descriptor, ignore_override=True)
    return config, stored


def _parameters() -> list[Parameter]:
    """Return the parameters that the node has."""
    return [p for p in configuration.parameters() if not p.key.startswith(FILES_ONLY)]


def _values(ros_parameters: Iterable[RosParameter]) -> dict[str, Any]:
    """Return the values of the parameters of this package by key; raises UnknownKeyError."""
    keys, values = [p.key for p in _parameters()], {}
    for p in ros_parameters:
        if p.name.startswith(EVERY_NODES):
            continue
        if p.name not in keys and not p.name.startswith(RECORD):
            raise UnknownKeyError(p.name, keys, SOURCE)
        # ROS gives an empty list no type, and other lists as arrays
        value = [] if p.type_ == RosParameter.Type.NOT_SET else p.value
        values[p.name] = value if isinstance(value, str | int | float) else list(value)
    return values


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return the descriptor shown by `ros2 param describe`."""
    texts = []
    if parameter.length:
        texts.append('a list of ' + ' or '.join(map(str, parameter.length)) + ' values')
    if parameter.choices:
        texts.append('one of ' + ', '.join(map(str, parameter.choices)))
    if parameter.key in FIXED:
        texts.append('fixed while the node runs')
    result = ParameterDescriptor(description=parameter.description, dynamic_typing=True,
                                 additional_constraints='; '.join(texts))
    low, high = parameter.minimum, parameter.maximum
    if low is not None and high is not None:
        if isinstance(parameter.default, int):
            result.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            result.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return result


def changed(config: Config, changes: Iterable[RosParameter]) -> Config:
    """
    Return the configuration with changes at run time.

    Raises BadValueError, and InputError for a key that is fixed.
    """
    values = _values(changes)
    changed_config = configuration.with_values(config, values, SOURCE)
    old, new = configuration.flatten(config), configuration.flatten(changed_config)
    for key in values:
        if key in FIXED and old[key] != new[key]:
            raise InputError(f'{key} is fixed while the node runs; set it at its start')
    _check_names(changed_config)
    return changed_config


def _check_names(config: Config) -> None:
    """Raise BadValueError for names of methods and folders that would fail later."""
    Session(config)
    folder_name(config)
