"""
The parameters of the node: those of config/, declared so that they explain themselves.

`ros2 param describe /handeye noise.sensor` prints the description and the range. Types are
dynamic, so that 3 is taken where 3.0 is meant; config/ checks every value.
"""
from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from handeye_ros import config as configuration
from handeye_ros import targets
from handeye_ros.config import Config, EVERY_NODES, Parameter, RECORD, RECORD_NAMES
from handeye_ros.errors import InputError, UnknownKeyError
from handeye_ros.output import folder_name
from handeye_ros.ros.sessions.reading import Stored
from handeye_ros.ros.sessions.store import Place, resumed
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

# What the node subscribes to, or tells others, from its start on.
FIXED = ('robot_base_frame', 'robot_effector_frame', 'session', 'page.port', 'page.address')
# Keys that serve only targets that are solved from files.
FILES_ONLY = ('tracker.', 'sensor_frame')


def declare(node: Node) -> tuple[Config, Stored | None]:
    """
    Declare all parameters of the node; return the configuration and the session to go on with.

    Raises UnknownKeyError and BadValueError for what the user gave, InputError for a session
    that cannot be read.

    """
    config, stored = resumed(_given(node), Place(node.get_namespace()))
    _check_names(config)
    values = configuration.flatten(config)
    for parameter in parameters():
        node.declare_parameter(parameter.key, values[parameter.key], descriptor(parameter),
                               ignore_override=True)
    about = ParameterDescriptor(description='Free text, kept with the answer.',
                                dynamic_typing=True)
    for name in dict.fromkeys((*RECORD_NAMES, *dict(config.record))):
        node.declare_parameter(f'{RECORD}{name}', dict(config.record).get(name, ''), about,
                               ignore_override=True)
    return config, stored


def parameters() -> tuple[Parameter, ...]:
    """Return the keys that serve the node."""
    return tuple(p for p in configuration.parameters() if not p.key.startswith(FILES_ONLY))


def _given(node: Node) -> dict[str, Any]:
    """Return what parameter files and arguments set, by key; raises UnknownKeyError."""
    # rclpy tells what was given only for names that it is asked for
    return _values(node._parameter_overrides.values())


def _values(given: Iterable[RosParameter]) -> dict[str, Any]:
    """Return the values of parameters that are ours, by key; raises UnknownKeyError."""
    values = {p.name: _value(p) for p in given if not p.name.startswith(EVERY_NODES)}
    known = [p.key for p in parameters()]
    for name in values:
        if name not in known and not name.startswith(RECORD):
            raise UnknownKeyError(name, known, "the node's parameters")
    return values


def _value(parameter: RosParameter) -> Any:
    """Return the value of a parameter; lists as lists, an empty one has no type in ROS."""
    if parameter.type_ == RosParameter.Type.NOT_SET:
        return []
    value = parameter.value
    return list(value) if not isinstance(value, str | int | float) else value


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return what `ros2 param describe` tells of a parameter."""
    made = ParameterDescriptor(description=parameter.description, dynamic_typing=True,
                               additional_constraints=_constraints(parameter))
    low, high = parameter.minimum, parameter.maximum
    if low is not None and high is not None:
        if isinstance(parameter.default, int):
            made.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            made.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return made


def _constraints(parameter: Parameter) -> str:
    parts = []
    if parameter.length:
        parts.append('a list of ' + ' or '.join(map(str, parameter.length)) + ' values')
    if parameter.choices:
        parts.append('one of ' + ', '.join(map(str, parameter.choices)))
    if parameter.key in FIXED:
        parts.append('fixed while the node runs')
    return '; '.join(parts)


def changed(config: Config, changes: Iterable[RosParameter]) -> Config:
    """
    Return config with a change at run time put in.

    Raises BadValueError, or InputError when the change has to be made at the start.

    """
    values = _values(changes)
    new = configuration.with_values(config, values, "the node's parameters")
    before, after = configuration.flatten(config), configuration.flatten(new)
    for key in values:
        if key in FIXED and before[key] != after[key]:
            raise InputError(f'{key} is fixed while the node runs; set it at its start')
    _check_names(new)
    return new


def _check_names(config: Config) -> None:
    """Refuse names that would only fail later; raises BadValueError."""
    targets.method_for(config)
    folder_name(config)
