"""Every key: the sections in their order, and all of them by dotted name."""
from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from typing import Any

from handeye_ros.config.answer import (
    GuidanceConfig,
    LimitsConfig,
    PageConfig,
    SaveConfig,
    VerifyConfig,
)
from handeye_ros.config.cell import (
    NoiseConfig,
    ProfileConfig,
    SamplesConfig,
    SamplingConfig,
    TargetConfig,
    TrackerConfig,
)
from handeye_ros.config.parameter import key, Parameter, parameters_of

# Of record.*, whose names are free: those that a form for acceptance has.
RECORD_NAMES = ('operator', 'sensor_serial', 'robot_serial', 'artefact', 'temperature', 'note')
RECORD = 'record.'
BASE_FRAME = 'base'
UNNAMED_FRAME = 'sensor'  # what the frame of profiles without a frame_id is called


@dataclass(frozen=True)
class Config:
    """Everything a user can set."""

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
        """Return the frame id of the robot base: BASE_FRAME where neither key nor poses tell."""
        return self.robot_base_frame or BASE_FRAME


@cache
def parameters() -> tuple[Parameter, ...]:
    """Return every key, in their order."""
    return tuple(parameters_of(Config(), ''))


def flatten(config: Config) -> dict[str, Any]:
    """Return the values of a configuration by dotted key; tuples become lists."""
    values = {p.key: _get(config, p.key) for p in parameters()}
    values |= {f'{RECORD}{name}': text for name, text in config.record}
    return {key: list(v) if isinstance(v, tuple) else v for key, v in values.items()}


def _get(config: Any, key: str) -> Any:
    for name in key.split('.'):
        config = getattr(config, name)
    return config
