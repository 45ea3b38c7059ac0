"""The keys: limits, outputs and the session of an answer, and all sections together."""
from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from typing import Any

from handeye_ros.config.cell import (
    NoiseConfig,
    ProfileConfig,
    SamplesConfig,
    SamplingConfig,
    TargetConfig,
    TrackerConfig,
)
from handeye_ros.config.parameter import key, Parameter, parameters_of

SAVE_FORMATS = ('yaml', 'urdf', 'launch', 'easy_handeye2', 'matrix', 'json', 'kuka',
                'fanuc', 'abb', 'ur', 'staubli', 'yaskawa')


@dataclass(frozen=True)
class LimitsConfig:
    """Largest uncertainty and inconsistency of a trusted answer."""

    translation: float = key(5e-3, 'Largest 1-sigma of the translation in its worst direction '
                             '(m).', minimum=0.0, maximum=1.0)
    rotation: float = key(2e-2, 'Largest 1-sigma of the rotation about its worst axis (rad).',
                          minimum=0.0, maximum=1.0)
    scatter: float = key(8.0, 'Largest RMS residual of a trusted answer, as a multiple of what '
                         'the configured noise makes.', minimum=1.0, maximum=1e6)
    residual: float = key(1e-3, 'Largest RMS residual of a trusted answer (m).',
                          minimum=0.0, maximum=1.0)


@dataclass(frozen=True)
class SaveConfig:
    """The files written for an answer."""

    formats: tuple[str, ...] = key(
        ('yaml',), 'The forms in which an answer is saved; calibration.yaml is always '
        'among them.', choices=SAVE_FORMATS, length=tuple(range(1, len(SAVE_FORMATS) + 1)))


@dataclass(frozen=True)
class GuidanceConfig:
    """The accuracy wanted, and the limits of proposed poses."""

    accuracy: float = key(3e-4, 'Wanted 1 sigma of points that the transform maps, over the '
                          'field of view (m): with it, the samples are enough.',
                          minimum=1e-6, maximum=0.1)
    reach: float = key(0.3, 'Largest distance of a proposed position of the flange from that '
                       'of the first sample (m).', minimum=0.0, maximum=5.0)
    tilt: float = key(0.44, 'Largest tilt of the viewing direction of a proposed pose, from '
                      'that of the first sample (rad).', minimum=0.05, maximum=1.2)
    turn: float = key(1.75, 'Largest turn of a proposed pose about the viewing direction, from '
                      'the first sample (rad).', minimum=0.0, maximum=3.15)


@dataclass(frozen=True)
class VerifyConfig:
    """The artefact of the node's verification."""

    routine: str = key('', 'What ~/verify_start measures: line, plane, point, sphere, ball_bar, '
                       'step, square or tooth; empty: nothing.')
    calibration: str = key('', 'File of the calibration that is verified; empty: the answer of '
                           'the node.')
    lengths: tuple[float, ...] = key(
        (), 'Nominal length of the ball bar, heights of the faces over the first, or pitch and '
        'height of the teeth (m).', minimum=1e-6, maximum=10.0)
    radius: float = key(0.0, 'Nominal radius of the balls (m); 0: unknown.',
                        minimum=0.0, maximum=10.0)
    reference: tuple[float, ...] = key(
        (), 'The point as a tip of the robot touched it (m, base); empty: not touched.',
        minimum=-50.0, maximum=50.0, length=(0, 3))
    aim: float = key(0.0, 'How exactly the laser is put to the point, 1 sigma (m).',
                     minimum=0.0, maximum=0.1)
    flank: float = key(0.0, "Horizontal way of a tooth's flank (m); 0: a quarter of the pitch.",
                       minimum=0.0, maximum=1.0)
    certificate: float = key(0.0, 'Expanded uncertainty (k = 2) of lengths, radius and reference '
                             "by the artefact's certificate (m).", minimum=0.0, maximum=0.1)
    near: tuple[float, ...] = key(
        (), 'Only what comes into this ball of the base takes part: x, y, z and radius (m); '
        'empty: everything.', minimum=-50.0, maximum=50.0, length=(0, 4))
    tolerance: float = key(3e-4, 'Largest error of a length that passes (m).',
                           minimum=1e-9, maximum=1.0)
    angle_tolerance: float = key(1.7453e-3, 'Largest error of an angle that passes '
                                 '(rad).', minimum=1e-9, maximum=1.0)


@dataclass(frozen=True)
class PageConfig:
    """The page for a browser at the cell."""

    port: int = key(0, 'Port of the page for a browser; 0: no page.', minimum=0, maximum=65535)
    address: str = key('127.0.0.1', 'Address that the page is served on: 127.0.0.1 for this '
                       'machine alone, 0.0.0.0 for all that can reach it; these need the token '
                       'that is printed at the start.')


# The usual names of record.* in a form for acceptance; others are allowed.
RECORD_NAMES = ('operator', 'sensor_serial', 'robot_serial', 'artefact', 'temperature', 'note')
RECORD = 'record.'
BASE_FRAME = 'base'
UNNAMED_FRAME = 'sensor'  # name for the frame of profiles without a frame_id


@dataclass(frozen=True)
class Config:
    """All settings."""

    name: str = key('', 'Name of the calibration, and of the folder it is saved in; empty: '
                    'the type of the target.')
    output_dir: str = key('', 'Folder in which results and sessions get their folder, called by '
                          'the name; empty: $ROS_HOME/handeye_ros (~/.ros/handeye_ros where '
                          'ROS_HOME is not set) and the namespace of the node, out of the '
                          'command line.')
    calibration_type: str = key('eye_in_hand', 'Where the sensor is: on the flange '
                                '(eye_in_hand) or fixed beside the robot (eye_on_base).',
                                choices=('eye_in_hand', 'eye_on_base'))
    robot_base_frame: str = key('', 'Frame id of the robot base; empty: that of the poses (of '
                                'the transform tree: base).')
    robot_effector_frame: str = key('flange', 'Frame id of the flange.')
    sensor_frame: str = key('camera', 'Frame id of a sensor whose files name none (points, '
                            'hand_eye).')
    pose_source: str = key('topic', 'Where the flange poses come from: PoseStamped messages '
                           '(topic) or the transform tree (tf).', choices=('topic', 'tf'))
    pose_topic: str = key('flange_pose', 'Topic of the flange poses.')
    profile_topic: str = key('profile', 'Topic of the laser profiles.')
    joint_topic: str = key('joint_states', 'Topic of the joint values (sensor_msgs/JointState).')
    kinematics: str = key('', 'A kinematics.yaml, made by handeye kinematics: the flange poses '
                          'are those of its corrected arm at the joint values of joint_topic; '
                          'empty: the poses of the controller.')
    robot_description: str = key('', 'File of the URDF of the robot, for ~/compute_kinematics: '
                                 'the flange poses are those of the URDF at the joint values of '
                                 'joint_topic; empty: none.')
    time_offset: float = key(0.0, "Added to the profiles' stamps (s), for a sensor whose clock "
                             'or whose driver is late or early.', minimum=-10.0, maximum=10.0)
    time_offset_std: float = key(
        0.05, 'How well time_offset is known (s, 1 sigma), where it is estimated '
        '(sampling.mode moving).', minimum=1e-6, maximum=1.0)
    rotation_lag_std: float = key(
        1e-3, 'By how much later than its position the robot may report its rotation (s, 1 '
        'sigma), where it is estimated (sampling.mode moving); 0: not at all.', minimum=0.0,
        maximum=0.1)
    profile: ProfileConfig = field(default_factory=ProfileConfig)
    target: TargetConfig = field(default_factory=TargetConfig)
    method: str = key('auto', 'The estimator; auto: the one of the target.')
    session: str = key('', 'The session to continue: its folder, or last; empty: a new one.')
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    samples: SamplesConfig = field(default_factory=SamplesConfig)
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    limits: LimitsConfig = field(default_factory=LimitsConfig)
    save: SaveConfig = field(default_factory=SaveConfig)
    guidance: GuidanceConfig = field(default_factory=GuidanceConfig)
    verify: VerifyConfig = field(default_factory=VerifyConfig)
    page: PageConfig = field(default_factory=PageConfig)
    record: tuple[tuple[str, str], ...] = ()  # record.*: names and texts, free

    @property
    def base_frame(self) -> str:
        """Return the frame id of the robot base, BASE_FRAME by default."""
        return self.robot_base_frame or BASE_FRAME


@cache
def parameters() -> tuple[Parameter, ...]:
    """Return every key, in their order."""
    return tuple(parameters_of(Config(), ''))


def flatten(config: Config) -> dict[str, Any]:
    """Return the values of a configuration by dotted key, but those not set; tuples as lists."""
    values = {p.key: _get(config, p.key) for p in parameters()}
    values = {key: value for key, value in values.items() if value == value}  # not NOT_SET
    values |= {f'{RECORD}{name}': text for name, text in config.record}
    return {key: list(v) if isinstance(v, tuple) else v for key, v in values.items()}


def _get(config: Any, key: str) -> Any:
    for name in key.split('.'):
        config = getattr(config, name)
    return config
