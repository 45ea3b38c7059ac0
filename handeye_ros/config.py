"""
The configuration: every default, its range and its description, in one place.

A dotted key (`noise.sensor`) is a ROS parameter of the node, a key of the YAML files in
config/ and a `--set` key of the command line alike. Metres, radians and seconds throughout.
"""
from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from itertools import accumulate
import math
from pathlib import Path
import re
from typing import Any

from handeye_ros.errors import BadValueError, ConfigFileError, InputError, UnknownKeyError
import yaml

SIGNED_AXES = ('x', 'y', 'z', '-x', '-y', '-z')
SAVE_FORMATS = ('yaml', 'urdf', 'launch', 'shell', 'easy_handeye2', 'matrix', 'json')
DEEPEST = 100  # nesting of brackets in a YAML file
UNNAMED_FRAME = 'sensor'  # what the frame of profiles without a frame_id is called
NODE = 'handeye'  # the name of the node, and of its section in parameter files
EVERY_NODES = ('use_sim_time', 'start_type_description_service', 'qos_overrides.')
"""Parameters that every ROS node has, and so a dump of ours: no keys of this package."""


def _key(default: Any, description: str, **limits: Any) -> Any:
    """Declare a key; limits: minimum, maximum (numbers), choices (strings)."""
    return field(default=default, metadata={'description': description, **limits})


@dataclass(frozen=True)
class ProfileConfig:
    """How the driver's messages are to be read."""

    unit: str = _key('m', 'Unit of the coordinates in the profile messages.', choices=('m', 'mm'))
    axes: tuple[str, ...] = _key(
        ('x', 'z'), 'Two signed axes of the message that span the sensor plane: along the '
        'laser line, and range.', choices=SIGNED_AXES, length=(2,))
    range_sign: int = _key(
        1, '1 if the range grows away from the sensor, -1 if it grows towards it.',
        choices=(1, -1), minimum=-1, maximum=1)
    rows: str = _key(
        'auto', 'What the rows of a message (its height) are: points of one profile, or profiles; '
        'auto: profiles where each runs along the whole line.',
        choices=('auto', 'points', 'profiles'))
    period: float = _key(
        0.0, 'Time between the profiles of one message (s); 0: unknown, and only those messages '
        'are used during which the robot stood still.', minimum=0.0, maximum=60.0)
    stamp: str = _key('first', 'Which profile of a message its stamp belongs to.',
                      choices=('first', 'middle', 'last'))
    invalid: tuple[float, ...] = _key(
        (), 'Ranges that mean no return, in the unit of the message, such as 0 or -327.68.',
        minimum=-1e9, maximum=1e9, length=(0, 1, 2, 3, 4))


@dataclass(frozen=True)
class TargetConfig:
    """What the laser is pointed at."""

    type: str = _key(  # noqa: A003
        'plate', 'The target: plate, line, plane, sphere or wedge; from files: points, hand_eye '
        'or tracker.')
    radius: float = _key(0.0, 'Radius of the sphere in m; 0: unknown, estimated.',
                         minimum=0.0, maximum=10.0)
    size: tuple[float, ...] = _key(
        (), 'Lengths of the plate along its edges p and q in m; empty: unknown, and only the '
        'two edges that meet in the corner are used.', minimum=0.0, maximum=10.0, length=(0, 2))
    radius_std: float = _key(5e-5, '1 sigma of the stated radius of the sphere (m).',
                             minimum=0.0, maximum=0.1)
    size_std: float = _key(1e-4, '1 sigma of each of the stated lengths of the plate (m).',
                           minimum=0.0, maximum=0.1)
    edge_angle_std: float = _key(3e-4, '1 sigma of the angle between the edges of the plate '
                                 '(rad).', minimum=0.0, maximum=0.1)
    setback_std: float = _key(3e-5, '1 sigma of how far the seen end of a face lies inside its '
                              'sharp edge: deburring, smoothing (m).', minimum=0.0, maximum=0.01)
    edge_angle_free: bool = _key(False, 'Estimate the angle between the edges of the plate '
                                 'instead of taking it as a right angle.')
    use_face: bool = _key(False, 'Use the face beside the straight edge (line) too; it must be '
                          'flat.')


@dataclass(frozen=True)
class SamplingConfig:
    """When the robot stands still, and what of a station is used."""

    mode: str = _key('still', 'When a sample is taken: by itself at every stop of the robot '
                     '(still), or when asked by ~/take_sample or ~/take (manual).',
                     choices=('still', 'manual'))
    still_time: float = _key(0.5, 'The robot stands still when its pose has not changed for '
                             'this long (s).', minimum=0.05, maximum=60.0)
    still_translation: float = _key(5e-4, 'Largest change of position of a robot that stands '
                                    'still (m).', minimum=0.0, maximum=0.1)
    still_rotation: float = _key(2e-3, 'Largest change of orientation of a robot that stands '
                                 'still (rad).', minimum=0.0, maximum=0.1)
    settle_time: float = _key(0.1, 'Profiles this soon after the robot stopped, or this shortly '
                              'before it starts, are left out (s).', minimum=0.0, maximum=10.0)
    max_pose_gap: float = _key(0.5, 'Poses further apart than this around a profile are too '
                               'sparse to interpolate (s).', minimum=1e-3, maximum=60.0)
    min_points: int = _key(20, 'Fewest points of a face or an arc in one profile.',
                           minimum=5, maximum=100000)
    min_crossing_angle: float = _key(0.44, 'A laser line that crosses an edge at a smaller '
                                     'angle is not used (rad).', minimum=0.0, maximum=1.5)
    new_translation: float = _key(
        8e-3, 'A stop nearer than this to an earlier one (m), and turned by less than '
        'new_rotation, brings nothing new and is not used; 0: every stop is used.',
        minimum=0.0, maximum=1.0)
    new_rotation: float = _key(
        0.05, 'A stop turned by less than this against an earlier one (rad), and nearer than '
        'new_translation, brings nothing new and is not used; 0: every stop is used.',
        minimum=0.0, maximum=3.15)

    @property
    def by_itself(self) -> bool:
        """Return whether a sample is taken at every stop without being asked for."""
        return self.mode == 'still'


@dataclass(frozen=True)
class SamplesConfig:
    """Which samples the answer comes from."""

    exclude: tuple[int, ...] = _key(
        (), 'Numbers of the samples that are left out; taking a number away brings it back.',
        minimum=1, maximum=10**6, whole=True)


@dataclass(frozen=True)
class TrackerConfig:
    """What is known of the laser tracker and of the arm that it follows (target.type tracker)."""

    file: str = _key('tracker.csv', 'Name of the file of reflector points beside the bag.')
    noise: float = _key(2e-5, 'Noise of a reflector centre, each axis (m).',
                        minimum=1e-9, maximum=0.01)
    h0: float = _key(0.0, 'Height of the reflector above the top of P3 (m).',
                     minimum=-10.0, maximum=10.0)
    h1: float = _key(0.0, 'Height of the top of P3 above the origin of frame 2 (m).',
                     minimum=-10.0, maximum=10.0)
    first_reading: float = _key(0.0, 'Reading of P3 at the first pose of the bag (m).',
                                minimum=-100.0, maximum=100.0)
    direction: tuple[float, ...] = _key(
        (0.0, 1.0, 0.0), 'Direction of the sweep in the sensor frame, roughly.',
        minimum=-1.0, maximum=1.0, length=(3,))


@dataclass(frozen=True)
class NoiseConfig:
    """What is known of the noise, 1 sigma; the data corrects it."""

    sensor: float = _key(3e-5, 'Range noise of one profile point (m).',
                         minimum=1e-9, maximum=0.01)
    distortion: float = _key(2e-5, "Smooth error of the sensor's field, its linearity (m).",
                             minimum=0.0, maximum=0.01)
    flatness: float = _key(2e-5, 'Smooth deviation of the faces of the target from flat (m).',
                           minimum=0.0, maximum=0.01)
    robot_translation: float = _key(3e-5, 'Repeatability of the flange position, each axis (m).',
                                    minimum=0.0, maximum=0.01)
    robot_rotation: float = _key(7e-5, 'Repeatability of the flange orientation, each axis '
                                 '(rad).', minimum=0.0, maximum=0.01)
    robot_smooth: float = _key(1e-4, 'Error of the robot that varies smoothly over its '
                               'workspace, each axis (m); the data corrects it.',
                               minimum=0.0, maximum=0.01)
    robot_scale: float = _key(5e-4, 'Relative error of the lengths of the robot.',
                              minimum=0.0, maximum=0.1)


@dataclass(frozen=True)
class LimitsConfig:
    """What is too uncertain or too inconsistent to publish."""

    translation: float = _key(5e-3, 'Largest 1-sigma of the translation in its worst direction '
                              '(m).', minimum=0.0, maximum=1.0)
    rotation: float = _key(2e-2, 'Largest 1-sigma of the rotation about its worst axis (rad).',
                           minimum=0.0, maximum=1.0)
    scatter: float = _key(8.0, 'Largest RMS residual of a trusted answer, as a multiple of what '
                          'the configured noise makes.', minimum=1.0, maximum=1e6)
    residual: float = _key(1e-3, 'Largest RMS residual of a trusted answer (m).',
                           minimum=0.0, maximum=1.0)


@dataclass(frozen=True)
class SaveConfig:
    """What is written of an answer."""

    formats: tuple[str, ...] = _key(
        ('yaml',), 'The forms in which an answer is saved; calibration.yaml is always '
        'among them.', choices=SAVE_FORMATS, length=tuple(range(1, len(SAVE_FORMATS) + 1)))


@dataclass(frozen=True)
class GuidanceConfig:
    """What is enough, and where a proposed pose may be."""

    accuracy: float = _key(1e-4, 'Wanted 1 sigma of points that the transform maps, over the '
                           'field of view (m): with it, the samples are enough.',
                           minimum=1e-6, maximum=0.1)
    reach: float = _key(0.3, 'Largest distance of a proposed position of the flange from that '
                        'of the first sample (m).', minimum=0.0, maximum=5.0)
    tilt: float = _key(0.44, 'Largest tilt of the viewing direction of a proposed pose, from '
                       'that of the first sample (rad).', minimum=0.05, maximum=1.2)
    turn: float = _key(1.75, 'Largest turn of a proposed pose about the viewing direction, from '
                       'the first sample (rad).', minimum=0.0, maximum=3.15)


@dataclass(frozen=True)
class VerifyConfig:
    """What the node's verification measures, and what is known of it."""

    routine: str = _key('', 'What ~/verify_start measures: line, plane, point, sphere, ball_bar, '
                        'step, square or tooth; empty: nothing.')
    calibration: str = _key('', 'File of the calibration that is verified; empty: the answer of '
                            'the node.')
    lengths: tuple[float, ...] = _key(
        (), 'Nominal length of the ball bar, heights of the faces over the first, or pitch and '
        'height of the teeth (m).', minimum=1e-6, maximum=10.0)
    radius: float = _key(0.0, 'Nominal radius of the balls (m); 0: unknown.',
                         minimum=0.0, maximum=10.0)
    reference: tuple[float, ...] = _key(
        (), 'The point as a tip of the robot touched it (m, base); empty: not touched.',
        minimum=-50.0, maximum=50.0, length=(0, 3))
    aim: float = _key(0.0, 'How exactly the laser is put to the point, 1 sigma (m).',
                      minimum=0.0, maximum=0.1)
    flank: float = _key(0.0, "Horizontal way of a tooth's flank (m); 0: a quarter of the pitch.",
                        minimum=0.0, maximum=1.0)
    tolerance: float = _key(3e-4, 'Largest error of a length that passes (m).',
                            minimum=1e-9, maximum=1.0)
    angle_tolerance: float = _key(1.7453e-3, 'Largest error of an angle that passes '
                                  '(rad).', minimum=1e-9, maximum=1.0)


@dataclass(frozen=True)
class PageConfig:
    """The page for a browser at the cell."""

    port: int = _key(0, 'Port of the page for a browser; 0: no page.', minimum=0, maximum=65535)
    address: str = _key('127.0.0.1', 'Address that the page is served on: 127.0.0.1 for this '
                        'machine alone, 0.0.0.0 for all that can reach it; these need the token '
                        'that is printed at the start.')


@dataclass(frozen=True)
class Config:
    """Everything a user can set."""

    name: str = _key('', 'Name of the calibration, and of the folder it is saved in; empty: '
                     'the type of the target.')
    output_dir: str = _key('', 'Folder in which results and sessions get their folder, called by '
                           'the name; empty: $ROS_HOME/handeye_ros (~/.ros/handeye_ros where '
                           'ROS_HOME is not set) and the namespace of the node, out of the '
                           'command line.')
    calibration_type: str = _key('eye_in_hand', 'Where the sensor is: on the flange '
                                 '(eye_in_hand) or fixed beside the robot (eye_on_base).',
                                 choices=('eye_in_hand', 'eye_on_base'))
    robot_base_frame: str = _key('base', 'Frame id of the robot base.')
    robot_effector_frame: str = _key('flange', 'Frame id of the flange.')
    sensor_frame: str = _key('camera', 'Frame id of a sensor whose files name none (points, '
                             'hand_eye).')
    pose_source: str = _key('topic', 'Where the flange poses come from: PoseStamped messages '
                            '(topic) or the transform tree (tf).', choices=('topic', 'tf'))
    pose_topic: str = _key('flange_pose', 'Topic of the flange poses.')
    profile_topic: str = _key('profile', 'Topic of the laser profiles.')
    time_offset: float = _key(0.0, "Added to the profiles' stamps (s), for a sensor whose clock "
                              'or whose driver is late or early.', minimum=-10.0, maximum=10.0)
    profile: ProfileConfig = field(default_factory=ProfileConfig)
    target: TargetConfig = field(default_factory=TargetConfig)
    method: str = _key('auto', 'The estimator; auto: the one of the target.')
    session: str = _key('', 'The session to go on with: its folder, or last; empty: a new one.')
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    samples: SamplesConfig = field(default_factory=SamplesConfig)
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    limits: LimitsConfig = field(default_factory=LimitsConfig)
    save: SaveConfig = field(default_factory=SaveConfig)
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    verify: VerifyConfig = field(default_factory=VerifyConfig)
    page: PageConfig = field(default_factory=PageConfig)


@dataclass(frozen=True)
class Parameter:
    """A dotted key with its default and what may be put there."""

    key: str
    default: Any
    description: str
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[Any, ...] = ()
    length: tuple[int, ...] = ()  # of a list; empty: any
    whole: bool = False  # a list of whole numbers

    @property
    def unit(self) -> str:
        """Return the unit that the description names, empty if none."""
        found = re.search(r'\((m|rad|s)\)|\bin (m|s)\b', self.description)
        return '' if found is None else found[1] or found[2]


def parameters() -> tuple[Parameter, ...]:
    """Return every key, in the order of this file."""
    return tuple(_parameters(Config(), ''))


def _parameters(part: Any, prefix: str) -> Iterable[Parameter]:
    for item in fields(part):
        value = getattr(part, item.name)
        if is_dataclass(value):
            yield from _parameters(value, f'{prefix}{item.name}.')
        else:
            yield Parameter(f'{prefix}{item.name}', value, **item.metadata)


def flatten(config: Config) -> dict[str, Any]:
    """Return the values of a configuration by dotted key; tuples become lists."""
    values = {p.key: _get(config, p.key) for p in parameters()}
    return {key: list(v) if isinstance(v, tuple) else v for key, v in values.items()}


def _get(config: Any, key: str) -> Any:
    for name in key.split('.'):
        config = getattr(config, name)
    return config


def with_values(config: Config, values: Mapping[str, Any], source: str) -> Config:
    """
    Return config with values by dotted key put in.

    source: what the values come from, for the message.
    Raises UnknownKeyError and BadValueError.
    """
    known = {p.key: p for p in parameters()}
    for key, value in values.items():
        if key not in known:
            raise UnknownKeyError(key, list(known), source)
        config = _put(config, key.split('.'), _checked(known[key], value))
    return config


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


def flipped_range(config: Config) -> Config:
    """Return the configuration with profile.range_sign the other way."""
    return replace(config, profile=replace(config.profile, range_sign=-config.profile.range_sign))


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
