"""
The parameters of the node: those of config.py, declared so that they explain themselves.

`ros2 param describe /handeye noise.sensor` prints the description and the range. Types are
dynamic, so that 3 is taken where 3.0 is meant; config.py checks every value.
"""
from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from handeye_ros import config as configuration
from handeye_ros import methods
from handeye_ros.config import Config, Parameter
from handeye_ros.errors import BadValueError, InputError, UnknownKeyError
from handeye_ros.results import calibration_file
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

OUTPUT_DIR = 'output_dir'  # of the node alone: the command line has --out
OUTPUT_DIR_DESCRIPTION = ('Folder in which save_calibration makes <name>/calibration.yaml; empty: '
                          '$ROS_HOME/handeye, which is ~/.ros/handeye where ROS_HOME is not set.')

# What the node subscribes to, or tells others, from its start on.
FIXED = ('robot_base_frame', 'robot_effector_frame', 'pose_source', 'pose_topic',
         'profile_topic', 'session')
# What the samples do not depend on; all other keys need that there are none.
FREE = ('name', 'limits.translation', 'limits.rotation', 'limits.residual', 'sampling.mode',
        'samples.exclude', 'save.formats', OUTPUT_DIR)

# Parameters that rclpy declares by itself, or on demand.
NOT_OURS = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')


def declare(node: Node) -> tuple[Config, str]:
    """
    Declare all parameters of the node; return the configuration and the output folder.

    Raises UnknownKeyError and BadValueError for what the user gave.

    """
    given = _given(node)
    output_dir = _checked_folder(given.pop(OUTPUT_DIR, ''))
    config = configuration.with_values(Config(), given, "the node's parameters")
    _check_names(config)
    for parameter in configuration.parameters():
        value = configuration.flatten(config)[parameter.key]
        node.declare_parameter(parameter.key, value, descriptor(parameter), ignore_override=True)
    node.declare_parameter(
        OUTPUT_DIR, output_dir, ParameterDescriptor(description=OUTPUT_DIR_DESCRIPTION),
        ignore_override=True)
    return config, output_dir


def _given(node: Node) -> dict[str, Any]:
    """Return what parameter files and arguments set, by key; raises UnknownKeyError."""
    known = {p.key: p for p in configuration.parameters()}
    # rclpy tells what was given only for names that it is asked for
    given = node._parameter_overrides.values()
    values = {p.name: p for p in given if not p.name.startswith(NOT_OURS)}
    for name in values:
        if name not in known and name != OUTPUT_DIR:
            raise UnknownKeyError(name, [*known, OUTPUT_DIR], "the node's parameters")
    return {name: _value(p) for name, p in values.items()}


def _value(parameter: RosParameter) -> Any:
    """Return the value of a parameter; lists as lists, an empty one has no type in ROS."""
    if parameter.type_ == RosParameter.Type.NOT_SET:
        return []
    value = parameter.value
    return list(value) if not isinstance(value, str | int | float) else value


def _checked_folder(value: Any) -> str:
    if not isinstance(value, str) or not value.isprintable():
        raise BadValueError(OUTPUT_DIR, value, 'the path of a folder')
    return value


def descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return what `ros2 param describe` tells of a parameter."""
    told = ParameterDescriptor(description=parameter.description, dynamic_typing=True,
                               additional_constraints=_constraints(parameter))
    low, high = parameter.minimum, parameter.maximum
    if low is not None and high is not None:
        if isinstance(parameter.default, int):
            told.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            told.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return told


def _constraints(parameter: Parameter) -> str:
    parts = []
    if parameter.length:
        parts.append('a list of ' + ' or '.join(map(str, parameter.length)) + ' values')
    if parameter.choices:
        parts.append('one of ' + ', '.join(map(str, parameter.choices)))
    if parameter.key in FIXED:
        parts.append('fixed while the node runs')
    elif parameter.key not in FREE:
        parts.append('cannot change while there are samples')
    return '; '.join(parts)


def changed(config: Config, changes: Iterable[RosParameter], samples: int) -> Config:
    """
    Return config with a change at run time put in.

    samples: how many there are now. Raises BadValueError, or InputError when the change has
    to wait or to be made at the start.

    """
    values = {p.name: _value(p) for p in changes if not p.name.startswith(NOT_OURS)}
    _checked_folder(values.pop(OUTPUT_DIR, ''))
    new = configuration.with_values(config, values, "the node's parameters")
    before, after = configuration.flatten(config), configuration.flatten(new)
    for key in values:
        if before[key] == after[key]:
            continue
        if key in FIXED:
            raise InputError(f'{key} is fixed while the node runs; set it at its start')
        if key not in FREE and samples:
            raise InputError(f'{key} cannot change while there are {samples} samples that were '
                             'taken with the old value; call ~/clear_samples first')
    _check_names(new)
    return new


def _check_names(config: Config) -> None:
    """Refuse names that would only fail later; raises BadValueError."""
    methods.of(config)
    calibration_file.folder_name(config)
