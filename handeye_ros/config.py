# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The configuration: every key with its default, description and range, in one place.

A dotted key (`noise.sensor`) is a ROS parameter of the node, a key of the YAML files in config/
and a `--set` key of the command line. Metres, radians and seconds throughout. The sections of keys
come first, then what sets their values, from files or by hand; a wrong value raises.
"""
from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from functools import cache
from itertools import chain
import math
from numbers import Integral, Real
from operator import attrgetter
from pathlib import Path
import re
from typing import Any

from handeye_ros.errors import (
    BadValueError,
    InputError,
    path_of,
    require_type,
    UnknownKeyError,
    unusable_file,
)
from handeye_ros.units import in_si
import yaml

NOT_SET = math.nan  # default of a number that changes an answer by its full size: it has none
# Accuracy classes of robots: 1 sigma of the smooth error of each axis (m), half of the largest
# error in data sheets.
ROBOT_CLASSES = {'calibrated': 5e-5, 'standard': 1.5e-4, 'unknown': 3e-4}
# a running node refuses to change these
AT_START_ONLY = ('robot_base_frame', 'robot_effector_frame', 'session', 'page.port',
                 'page.address')
SIGNED_AXES = ('x', 'y', 'z', '-x', '-y', '-z')
# FORMATS of results/exports.py says how each is written; test_exports.py compares the two.
SAVE_FORMATS = ('yaml', 'urdf', 'launch', 'easy_handeye2', 'matrix', 'json', 'kuka',
                'fanuc', 'abb', 'ur', 'staubli', 'yaskawa')
# values of target.type that are solved from files: FILE_TARGETS in tabulated/
SOLVED_FROM_FILES = ('points', 'hand_eye', 'tracker')
# The usual names of record.* in a form for acceptance; others are allowed.
RECORD_NAMES = ('operator', 'sensor_serial', 'robot_serial', 'artefact', 'temperature', 'note')
RECORD_PREFIX = 'record.'
BASE_FRAME = 'base'
MAX_TIME_OFFSET = 10.0  # s: of the key time_offset
UNNAMED_FRAME = 'sensor'  # name for the frame of profiles without a frame_id
BAD_YAML = yaml.YAMLError, ValueError, RecursionError  # ValueError: of an invalid date or number
MAX_TEXT_LENGTH = 1000  # characters of a record.*
NODE_NAME = 'handeye'  # the name of the node, and of its section in parameter files
# Parameters of every ROS node, also in a dump of ours.
ROS_OWN_PARAMETERS = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')


def setting(default: Any, description: str, minimum: float | None = None,
            maximum: float | None = None, unit: str = '', **limits: Any) -> Any:
    """Declare a key, with the range of a number; limits: choices and length."""
    return field(default=default, metadata={
        'description': description + (f' In {unit}.' if unit else ''), 'minimum': minimum,
        'maximum': maximum, 'unit': unit, **limits})


@dataclass(frozen=True)
class Parameter:
    """A dotted key with its default and its range."""

    key: str
    default: Any
    description: str = ''
    minimum: float | None = None
    maximum: float | None = None
    unit: str = ''  # of a number: m, rad or s
    choices: tuple[Any, ...] = ()
    length: tuple[int, ...] = ()  # of a list; empty: any

    def checked(self, value: Any) -> Any:
        """Return a value in the type of the default; raises BadValueError for a wrong one."""
        if not isinstance(self.default, tuple):
            return self._checked_item(value, type(self.default))
        items = [] if value is None else value
        if not isinstance(items, list | tuple) or self.length and len(items) not in self.length:
            lengths = ' or '.join(map(str, self.length)) or 'any number of'
            raise BadValueError(self.key, value, f'a list of {lengths} values')
        kind = str if self.choices else type(self.minimum)  # whole numbers if their range is
        return tuple(self._checked_item(item, kind) for item in items)

    def _checked_item(self, value: Any, kind: type[Any]) -> Any:
        """Return one value of a type, as plain Python; raises BadValueError."""
        plain, low, high = _converted(value, kind), self.minimum, self.maximum
        accepted, expected = type(plain) is kind, f'a value of type {kind.__name__}'
        if self.choices:
            accepted &= plain in self.choices
            expected = f'one of {", ".join(map(str, self.choices))}'
        elif low is not None:
            accepted = accepted and low <= plain <= high
            whole = 'whole ' if kind is int else ''
            expected = f'a {whole}number from {low:g} to {high:g} {self.unit}'.rstrip()
        elif accepted and kind is str:
            accepted = plain.isprintable() and plain == plain.strip() and (
                plain or not self.default)
            example = f' such as {self.default}' if self.default else ''
            expected = f'a text{example} without control characters, or blanks around it'
        if not accepted:
            raise BadValueError(self.key, value, expected)
        return plain


def _converted(value: Any, kind: type[Any]) -> Any:
    """
    Return the value as the given type where it stands for one; otherwise return it unchanged.

    The text 3e-5 stands for a float (to YAML it is no number), None for an empty text.
    """
    if kind is str and value is None:
        return ''
    convertible: tuple[type, ...] = {int: (Integral,), float: (Real, str)}.get(kind, ())
    if isinstance(value, convertible) and not isinstance(value, bool):
        with suppress(ValueError, OverflowError):
            return kind(value)
    return value


@dataclass(frozen=True)
class Section:
    """
    Keys, whose values are checked wherever a section is made, in code or from a file.

    The name of the class is the first part of the dotted keys: those of ProfileConfig are
    profile.unit and so on.
    """

    def __post_init__(self) -> None:
        """Raise BadValueError for a value that its key does not take."""
        for name, parameter in _parameters_of(type(self)).items():  # type: ignore[arg-type]
            value = getattr(self, name)
            if value is not parameter.default:
                object.__setattr__(self, name, parameter.checked(value))


@cache
def _parameters_of(section: Any) -> dict[str, Parameter]:
    """Return the keys of a class of sections by field, those that are sections included."""
    prefix = section.__name__.removesuffix('Config').lower()
    return {item.name: Parameter(f'{prefix}.{item.name}'.lstrip('.'), item.default,
                                 **item.metadata)
            for item in fields(section) if item.name != 'record'}


@dataclass(frozen=True)
class ProfileConfig(Section):
    """How to read the messages of the profiler's driver."""

    unit: str = setting('m', 'Unit of the coordinates in the messages.', choices=('m', 'mm'))
    axes: tuple[str, ...] = setting(
        ('x', 'z'), 'Two signed axes of the message: along the laser line, and range.',
        choices=SIGNED_AXES, length=(2,))
    range_sign: int = setting(
        1, '1 if the range grows away from the sensor, -1 if towards it.', -1, 1, choices=(1, -1))
    rows: str = setting(
        'auto', 'What the rows of a message are: points of one profile, or profiles; auto: '
        'profiles where each runs along the whole line.',
        choices=('auto', 'points', 'profiles'))
    period: float = setting(
        0.0, 'Time between the profiles of one message; 0: unknown, and only those messages '
        'are used during which the robot stood still.', 0.0, 60.0, 's')
    exposure: float = setting(0.0, 'Time that a profile averages over, in motion.', 0.0, 0.1, 's')
    stamp: str = setting('first', 'Which profile of a message its stamp belongs to.',
                         choices=('first', 'middle', 'last'))
    invalid: tuple[float, ...] = setting(
        (), 'Ranges that mean no return, in the unit of the message, such as 0 or -327.68.',
        -1e10, 1e10, length=(0, 1, 2, 3, 4))

    def __post_init__(self) -> None:
        """Raise BadValueError also for two axes along one line."""
        super().__post_init__()
        if self.axes[0][-1] == self.axes[1][-1]:
            raise BadValueError('profile.axes', list(self.axes), 'two different axes')


@dataclass(frozen=True)
class TargetConfig(Section):
    """The target that the laser line crosses."""

    type: str = setting(  # noqa: A003
        'plate', 'plate, line, plane, sphere or wedge; from files: points, hand_eye or tracker.')
    radius: float = setting(0.0, 'Radius of the sphere; 0: unknown, estimated.', 0.0, 10.0, 'm')
    size: tuple[float, ...] = setting(
        (), 'Lengths of the plate along its edges p and q; empty: unknown, only the two '
        'edges that meet in the corner are used.', 1e-3, 10.0, 'm', length=(0, 2))
    radius_std: float = setting(5e-5, '1 sigma of the radius of the sphere.', 0.0, 0.1, 'm')
    size_std: float = setting(1e-4, '1 sigma of each length of the plate.', 0.0, 0.1, 'm')
    edge_angle_std: float = setting(
        3e-4, '1 sigma of the angle between the edges of the plate.', 0.0, 0.1, 'rad')
    setback_std: float = setting(
        3e-5, '1 sigma of how far a face seems to end inside its sharp edge.', 0.0, 0.01, 'm')
    edge_angle_free: bool = setting(
        False, 'Estimate the angle between the edges of the plate; otherwise a right angle.')
    angles: str = setting(
        '', 'How a table of poses writes orientations: kuka-abc, fanuc-wpr, abb-quaternion, '
        'ur-rotation-vector, staubli-rxryrz, yaskawa-rxryrz; empty: quaternion x y z w, or roll '
        'pitch yaw, as its columns say.')
    use_face: bool = setting(False, 'Use the flat face beside the straight edge (line) too.')


@dataclass(frozen=True)
class SamplingConfig(Section):
    """When a sample is taken, when the robot stands still, and which profiles and stops count."""

    mode: str = setting(
        'still', 'When a sample is taken: automatically at every stop (still), when asked by '
        '~/take_sample or ~/take (manual), or of single profiles while the robot moves (moving).',
        choices=('still', 'manual', 'moving'))
    still_time: float = setting(
        0.5, 'The robot stands still when its pose did not change for this long.', 0.05, 9.0, 's')
    still_translation: float = setting(
        5e-4, 'Largest change of position of a robot that stands still.', 0.0, 0.1, 'm')
    still_rotation: float = setting(
        2e-3, 'Largest change of orientation of a robot that stands still.', 0.0, 0.1, 'rad')
    settle_time: float = setting(
        0.1, 'Profiles so soon after a stop begins or before it ends are unused.', 0.0, 4.0, 's')
    max_pose_gap: float = setting(
        0.5, 'Poses further apart than this around a profile are too sparse.', 1e-3, 60.0, 's')
    min_points: int = setting(20, 'Fewest points of a face or an arc in one profile.', 5, 100000)
    min_crossing_angle: float = setting(
        0.44, 'A laser line that crosses an edge of the plate at a smaller angle is not used.',
        0.0, 1.5, 'rad')
    new_translation: float = setting(
        8e-3, 'A stop nearer than this to an earlier one, and turned by less than '
        'new_rotation, is not used; 0: every stop is used.', 0.0, 1.0, 'm')
    new_rotation: float = setting(
        0.05, 'The turn that goes with new_translation; 0: every stop is used.', 0.0, 3.15, 'rad')

    @property
    def automatic(self) -> bool:
        """Return whether samples are taken automatically."""
        return self.mode != 'manual'

    @property
    def moving(self) -> bool:
        """Return whether samples are taken while the robot moves."""
        return self.mode == 'moving'


@dataclass(frozen=True)
class SamplesConfig(Section):
    """Which samples the answer does not use."""

    exclude: tuple[int, ...] = setting(
        (), 'Numbers of the excluded samples; taking a number away includes it again.', 1, 10**6)


@dataclass(frozen=True)
class TrackerConfig(Section):
    """Properties of the laser tracker and of the arm that it measures (target.type tracker)."""

    file: str = setting('tracker.csv', 'Name of the file of reflector points beside the bag.')
    noise: float = setting(2e-5, 'Noise of a reflector centre, each axis.', 1e-9, 0.01, 'm')
    h0: float = setting(NOT_SET, 'Height of the reflector above the top of P3.', -10.0, 10.0, 'm')
    h1: float = setting(NOT_SET, 'Height of the top of P3 above frame 2.', -10.0, 10.0, 'm')
    first_reading: float = setting(NOT_SET, 'Reading of P3 at the first pose.', -100.0, 100.0, 'm')
    direction: tuple[float, ...] = setting(
        (0.0, 1.0, 0.0), 'Direction of the sweep in the sensor frame, roughly.', -1.0, 1.0,
        length=(3,))


@dataclass(frozen=True)
class NoiseConfig(Section):
    """
    Prior noise, 1 sigma; the data correct it.

    robot_class sets robot_smooth where values are set by key (with_values); here it does not.
    """

    sensor: float = setting(3e-5, 'Range noise of one profile point.', 1e-9, 0.01, 'm')
    distortion: float = setting(2e-5, "Smooth error of the sensor's field.", 0.0, 0.01, 'm')
    line_bend: float = setting(1e-4, 'Bend of the laser line, at its ends.', 0.0, 0.01, 'm')
    flatness: float = setting(2e-5, 'Smooth deviation of the faces from flat.', 0.0, 0.01, 'm')
    robot_translation: float = setting(
        3e-5, 'Repeatability of the flange position, each axis.', 0.0, 0.01, 'm')
    robot_rotation: float = setting(
        7e-5, 'Repeatability of the flange orientation, each axis.', 0.0, 0.01, 'rad')
    stamps: float = setting(1e-4, 'Jitter of the stamps of profiles, in motion.', 0.0, 0.1, 's')
    robot_smooth: float = setting(
        1.5e-4, 'Smooth error of the robot over its workspace, each axis.', 0.0, 0.01, 'm')
    robot_class: str = setting(
        '', 'Accuracy of the robot by its data sheet: calibrated (0.1 mm), standard (0.3 mm) or '
        'unknown; sets robot_smooth where that is not given too.', choices=('', *ROBOT_CLASSES))
    robot_scale: float = setting(7e-4, 'Relative error of the lengths of the robot.', 0.0, 0.1)


@dataclass(frozen=True)
class LimitsConfig(Section):
    """Largest uncertainty and inconsistency of a trusted answer."""

    translation: float = setting(
        5e-3, 'Largest 1 sigma of the translation in its worst direction.', 0.0, 1.0, 'm')
    rotation: float = setting(
        2e-2, 'Largest 1 sigma of the rotation, worst axis.', 0.0, 1.0, 'rad')
    points: float = setting(
        2e-3, 'Largest 1 sigma of the points that the samples show, in the frame of the result, '
        'on average and in the worst direction.', 0.0, 1.0, 'm')
    scatter: float = setting(
        8.0, 'Largest RMS residual, as a multiple of what the configured noise makes.', 1.0, 1e6)
    residual: float = setting(1e-3, 'Largest RMS residual.', 0.0, 1.0, 'm')


@dataclass(frozen=True)
class SaveConfig(Section):
    """The files written for an answer."""

    formats: tuple[str, ...] = setting(
        ('yaml',), 'The forms in which an answer is saved; calibration.yaml always is.',
        choices=SAVE_FORMATS, length=tuple(range(1, len(SAVE_FORMATS) + 1)))


@dataclass(frozen=True)
class GuidanceConfig(Section):
    """
    The wanted accuracy of mapped points, and the limits of proposed poses.

    The limits are how far a proposed pose may be from that of the first sample.
    """

    accuracy: float = setting(
        3e-4, '1 sigma of mapped points in the field of view that is enough.', 1e-6, 0.1, 'm')
    reach: float = setting(
        0.3, 'Largest distance of a proposed flange position to the first sample.', 0.0, 5.0, 'm')
    tilt: float = setting(
        0.44, 'Largest tilt of a proposed view from that of the first sample.', 0.05, 1.2, 'rad')
    turn: float = setting(
        1.75, 'Largest turn of a proposed view about itself, from the first.', 0.0, 3.15, 'rad')


@dataclass(frozen=True)
class VerifyConfig(Section):
    """The artefact of a verification."""

    routine: str = setting(
        '', 'What ~/verify_start measures: line, plane, point, sphere, ball_bar, step or '
        'square; empty: nothing.')
    calibration: str = setting(
        '', 'File of the calibration that is verified; empty: the answer of the node.')
    lengths: tuple[float, ...] = setting(
        (), 'Nominal length of the ball bar, heights of the faces over the first (of each block, '
        'each time it is laid), or pitch and height of the teeth.', 1e-6, 10.0, 'm')
    radius: float = setting(0.0, 'Nominal radius of the balls; 0: unknown.', 0.0, 10.0, 'm')
    reference: tuple[float, ...] = setting(
        (), 'The point as a tip of the robot touched it, in the base (with eye_on_base: in the '
        'flange); empty: not touched.',
        -50.0, 50.0, 'm', length=(0, 3))
    aim: float = setting(0.0, 'How exactly the laser is put to the point, 1 sigma.', 0.0, 0.1, 'm')
    flank: float = setting(
        0.0, "Horizontal way of a tooth's flank; 0: a quarter of the pitch.", 0.0, 1.0, 'm')
    certificate: float = setting(
        0.0, "Expanded uncertainty (k = 2) of lengths, radius and reference by the artefact's "
        'certificate.', 0.0, 0.1, 'm')
    near: tuple[float, ...] = setting(
        (), 'Only what comes into this ball of the base (with eye_on_base: of the flange) takes '
        'part: x, y, z and radius; empty: everything.', -50.0, 50.0, 'm', length=(0, 4))
    tolerance: float = setting(3e-4, 'Largest error of a length that passes.', 1e-9, 0.02, 'm')
    angle_tolerance: float = setting(
        1.7453e-3, 'Largest angle error that passes.', 1e-9, 0.05, 'rad')


@dataclass(frozen=True)
class PageConfig(Section):
    """The page for a browser at the cell."""

    port: int = setting(0, 'Port of the page for a browser; 0: no page.', 0, 65535)
    address: str = setting(
        '127.0.0.1', 'Address of the page: 127.0.0.1 for this machine alone, 0.0.0.0 for all that '
        'can reach it; these need the token in the file named at the start.')


@dataclass(frozen=True)
class Config(Section):
    """All settings."""

    name: str = setting('', 'Name of the calibration and of its folder; empty: the target type.')
    output_dir: str = setting(
        '', 'Folder of the folders of results and sessions, each called by the name; empty: '
        '$ROS_HOME/handeye_ros/NAMESPACE for the node (ROS_HOME is ~/.ros where it is not set), '
        'the folder out for the command line.')
    calibration_type: str = setting(
        'eye_in_hand', 'Where the sensor is: on the flange (eye_in_hand) or fixed beside the '
        'robot (eye_on_base).', choices=('eye_in_hand', 'eye_on_base'))
    robot_base_frame: str = setting(
        '', 'Frame id of the robot base; empty: that of the poses (of the transform tree: base).')
    robot_effector_frame: str = setting('flange', 'Frame id of the flange.')
    sensor_frame: str = setting('camera', 'Frame id of a sensor whose files name none.')
    pose_source: str = setting(
        'topic', 'Where flange poses come from: PoseStamped messages (topic) or the transform '
        'tree (tf).', choices=('topic', 'tf'))
    pose_topic: str = setting('flange_pose', 'Topic of the flange poses.')
    profile_topic: str = setting('profile', 'Topic of the laser profiles.')
    joint_topic: str = setting(
        'joint_states', 'Topic of the joint values (sensor_msgs/JointState).')
    kinematics: str = setting(
        '', 'A kinematics.yaml of handeye kinematics: flange poses are those of its corrected arm '
        'at the joint values of joint_topic; empty: those of the controller.')
    time_offset: float = setting(0.0, 'Added to the stamps of the profiles.',
                                 -MAX_TIME_OFFSET, MAX_TIME_OFFSET, 's')
    time_offset_std: float = setting(
        0.05, 'How well time_offset is known (1 sigma), in sampling.mode moving.', 1e-6, 1.0, 's')
    rotation_lag_std: float = setting(
        1e-3, 'By how much later than its position the robot may report its rotation (1 '
        'sigma), with sampling.mode moving; 0: not at all.', 0.0, 0.1, 's')
    clock_drift_std: float = setting(
        1e-4, 'By how much the clocks of profiles and poses may differ in rate (1 sigma, seconds '
        'per second), with sampling.mode moving; 0: not at all.', 0.0, 0.01)
    profile: ProfileConfig = ProfileConfig()
    target: TargetConfig = TargetConfig()
    method: str = setting('auto', 'The estimator; auto: the one of the target.')
    session: str = setting('', 'The session to continue: its folder, or last; empty: a new one.')
    sampling: SamplingConfig = SamplingConfig()
    samples: SamplesConfig = SamplesConfig()
    tracker: TrackerConfig = TrackerConfig()
    noise: NoiseConfig = NoiseConfig()
    limits: LimitsConfig = LimitsConfig()
    save: SaveConfig = SaveConfig()
    guidance: GuidanceConfig = GuidanceConfig()
    verify: VerifyConfig = VerifyConfig()
    page: PageConfig = PageConfig()
    record: tuple[tuple[str, str], ...] = ()  # record.*: names and texts, free

    @property
    def calibration_name(self) -> str:
        """Return the name of the calibration, by default the type of the target."""
        return self.name or self.target.type

    @property
    def in_hand(self) -> bool:
        """Return whether the sensor is on the flange, else beside the robot."""
        return self.calibration_type == 'eye_in_hand'

    @property
    def other_calibration_type(self) -> str:
        """Return the calibration type that is not set."""
        return 'eye_on_base' if self.in_hand else 'eye_in_hand'

    @property
    def offset_ns(self) -> int:
        """Return the time offset as it is added to the stamps of profiles (ns)."""
        return round(self.time_offset * 1e9)

    @property
    def base_frame(self) -> str:
        """Return the frame id of the robot base, BASE_FRAME by default."""
        return self.robot_base_frame or BASE_FRAME

    @property
    def key_of_poses(self) -> str:
        """Return the key of the topic that the flange poses come from, '' where that is /tf."""
        return ('joint_topic' if self.kinematics else
                'pose_topic' if self.pose_source == 'topic' else '')

    @property
    def topic_of_poses(self) -> str:
        """Return the topic that the flange poses come from."""
        return {'joint_topic': self.joint_topic, 'pose_topic': self.pose_topic}.get(
            self.key_of_poses, '/tf')


@cache
def parameters() -> tuple[Parameter, ...]:
    """Return all keys, in the order of their declaration."""
    return tuple(chain.from_iterable(
        _parameters_of(type(p.default)).values() if isinstance(  # type: ignore[arg-type]
            p.default, Section) else [p]
        for p in _parameters_of(Config).values()))


def flatten(config: Config) -> dict[str, Any]:
    """Return the values by dotted key, without those that are NOT_SET; tuples become lists."""
    values = {p.key: attrgetter(p.key)(config) for p in parameters()}
    values = {key: value for key, value in values.items() if value == value}  # not NOT_SET
    values |= record_texts(config)
    return {key: list(v) if isinstance(v, tuple) else v for key, v in values.items()}


def record_texts(config: Config) -> dict[str, str]:
    """Return the free texts of a configuration by dotted key."""
    return {f'{RECORD_PREFIX}{name}': text for name, text in config.record}


def with_values(config: Config, values: Mapping[str, Any], source: str = 'values') -> Config:
    """
    Return a configuration with values by dotted key, such as {'target.type': 'sphere'}.

    source: of the values, for the message. Raises InputError, also for a value of a wrong type.
    """
    require_type('config', config, Config)
    require_type('values', values, Mapping)
    known = [p.key for p in parameters()]
    robot = values.get('noise.robot_class')
    if isinstance(robot, str) and robot in ROBOT_CLASSES:
        values = {'noise.robot_smooth': ROBOT_CLASSES[robot], **values}
    elif robot == '' and config.noise.robot_class:
        values = {'noise.robot_smooth': NoiseConfig().robot_smooth, **values}
    for key, value in values.items():
        require_type('a key of the values', key, str)
        section, _, name = key.rpartition('.')
        if key.startswith(RECORD_PREFIX):
            config = _with_record(config, key, value)
        elif key not in known:
            raise UnknownKeyError(key, known, source)
        elif section:
            config = replace(config, **{
                section: replace(getattr(config, section), **{name: value})})
        else:
            config = replace(config, **{name: value})
    return config


def from_provenance(values: Any) -> Config:
    """Return the configuration of a calibration file; what other versions know is ignored."""
    usable = {}
    for key, value in values.items() if isinstance(values, Mapping) else ():
        with suppress(InputError):
            with_values(Config(), {key: value})
            usable[key] = value
    return with_values(Config(), usable)


def with_assignments(config: Config, assignments: Iterable[str]) -> Config:
    """Return a configuration with `key=value` texts (values in YAML) applied; see assignment."""
    values: dict[str, Any] = {}
    for key, text in map(assignment, assignments):
        try:
            values[key] = text if key.startswith(RECORD_PREFIX) else yaml.safe_load(text)
        except BAD_YAML as error:
            raise InputError(f'the value of "{key}={text}" is not valid YAML') from error
    return with_values(config, values, '--set')


def assignment(text: str) -> tuple[str, str]:
    """Return the key and the value of `key=value`, its numbers with a unit (20mm) in SI units."""
    key, equals, value = text.partition('=')
    if not equals:
        raise InputError(f'"{text}" is not of the form key=value')
    key = key.strip()
    return key, in_si(value, next((p.unit for p in parameters() if p.key == key), ''))


def with_flipped_range(config: Config) -> Config:
    """Return the configuration with the opposite profile.range_sign."""
    return replace(config, profile=replace(config.profile, range_sign=-config.profile.range_sign))


def _with_record(config: Config, key: str, value: Any) -> Config:
    """Return a configuration with a free text of the record; an empty one removes it."""
    name, text = key.removeprefix(RECORD_PREFIX), '' if value is None else str(value)
    if not isinstance(value, str | int | float | None) or isinstance(value, bool):
        raise BadValueError(key, value, 'a text: write it in quotes')
    if not re.fullmatch(r'[A-Za-z]\w*', name):
        raise BadValueError(key, value, 'a name of letters, digits and _ after record.')
    if len(text) > MAX_TEXT_LENGTH or not text.isprintable():
        raise BadValueError(key, value, f'one line of at most {MAX_TEXT_LENGTH} characters')
    record = {**dict(config.record), name: text}
    return replace(config, record=tuple((n, t) for n, t in record.items() if t))


class _UniqueKeyLoader(yaml.SafeLoader):
    """Refuses a key that stands twice: PyYAML takes the second, a node merges both."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Return a mapping as SafeLoader does; raises YAMLError."""
        names = [key.value for key, _ in node.value]
        if twice := [name for name in names if names.count(name) > 1]:
            raise yaml.YAMLError(f'the key "{twice[0]}" stands twice{node.start_mark}')
        for key, value in node.value:  # a serial number 007 keeps its zeros
            texts = (value.value if key.value == 'record' and isinstance(value, yaml.MappingNode)
                     else [(key, value)] if str(key.value).startswith(RECORD_PREFIX) else [])
            for _, text in texts:
                if isinstance(text, yaml.ScalarNode):
                    text.tag = 'tag:yaml.org,2002:str'
        return super().construct_mapping(node, deep)


def read_yaml(path: Path) -> Any:
    """Return the content of a YAML file; raises InputError."""
    try:
        return yaml.load(path.read_text(encoding='utf-8'), _UniqueKeyLoader)
    except OSError as error:
        raise unusable_file(path, error.strerror or str(error)) from error
    except BAD_YAML as error:
        raise unusable_file(path, f'it is not valid YAML: {error}') from error


def load(path: Path | str, config: Config | None = None) -> Config:
    """
    Return a configuration (default: the defaults) with the values of a ROS parameter file.

    Those of the sections for all nodes (`/**`), then those for a node of our name in any
    namespace, also as `ros2 param dump` writes them. Raises InputError, also for a file without
    such a section.
    """
    path = path_of('path', path)
    sections: dict[str, dict[str, Any]] = {}  # by the full name of the node
    for names, value in _leaves_of(read_yaml(path)):
        if 'ros__parameters' in (names if value == {} else names[:-1]):
            place = names.index('ros__parameters')
            section = sections.setdefault(
                ''.join(f'/{name.strip("/")}' for name in names[:place]), {})
            key = '.'.join(names[place + 1:])
            if key in section:
                raise InputError(f'{path}: the key "{key}" stands twice')
            is_section = any(p.key.startswith(f'{key}.') for p in parameters())
            if key and not (value is None and is_section):  # all its keys are comments
                section[key] = value
    for_all = [node for node in sections if node.split('/')[-1] in ('*', '**')]
    for_ours = [node for node in sections if node.split('/')[-1] == NODE_NAME]
    if not for_all and not for_ours:
        raise InputError(f'{path} holds the parameters of {", ".join(sections) or "no node"}, and '
                         f'none of them is "{NODE_NAME}": give the calibration a section "/**:" '
                         'or of that name, below it "ros__parameters:", below it the keys')
    if len(for_ours) > 1:
        raise InputError(f'{path} holds the parameters of {", ".join(for_ours)}: keep those of '
                         f'one "{NODE_NAME}"')
    values = {key: value for node in (*for_all, *for_ours) for key, value in sections[node].items()
              if not key.startswith(ROS_OWN_PARAMETERS)}
    return with_values(config or Config(), values, str(path))


def _leaves_of(content: Any, names: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the names that lead to each value in nested mappings, and the value."""
    if not isinstance(content, dict) or not content and names:
        yield names, content
        return
    for name, value in content.items():
        yield from _leaves_of(value, (*names, str(name)))
