# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Where poses of the flange come from: a topic, the transform tree, or the joints of an arm."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

from handeye_ros import se3
from handeye_ros.arm import Arm
from handeye_ros.bags.messages import (
    message_of,
    pose_from_cdr,
    stamp_and_frame,
    transforms_from_cdr,
)
from handeye_ros.bags.storage import JOINTS_TYPE, POSE_TYPE, TF_TYPE
from handeye_ros.bags.transforms import FlangeFollower
from handeye_ros.config import Config
from handeye_ros.data import Array, TimedPose
from handeye_ros.errors import InputError, UnusableMessageError
from handeye_ros.results.kinematics_file import read_arm
import numpy as np


class PoseTopic(NamedTuple):
    """
    A topic with poses of the flange, and how they are read.

    key: of the configuration, that names it; '' for one of the transform tree
    message_type: as in storage.py
    read: returns the poses that a serialised message makes known, or raises UnusableMessageError
    """

    name: str
    key: str
    message_type: str
    read: Callable[[bytes], Sequence[TimedPose]]


def pose_topics(config: Config, follower: FlangeFollower, arm: Arm | None = None
                ) -> list[PoseTopic]:
    """
    Return the topics with the poses; the last is the required one, which moves the flange.

    follower: follows the transforms, where they are read; arm: gives the poses from joint values,
    as with the key kinematics. Raises InputError for a file of an arm that is none.
    """
    key = 'joint_topic' if arm else config.key_of_poses
    if key == 'joint_topic':
        robot = arm or read_arm(Path(config.kinematics))
        return [PoseTopic(config.joint_topic, key, JOINTS_TYPE,
                          lambda data: [pose_from_joints(robot, data)])]
    if key:
        return [PoseTopic(config.pose_topic, key, POSE_TYPE, lambda data: [pose_from_cdr(data)])]

    def poses_of(data: bytes, static: bool) -> Sequence[TimedPose]:
        return follower.add(transforms_from_cdr(data), static)

    return [PoseTopic('/tf_static', '', TF_TYPE, partial(poses_of, static=True)),
            PoseTopic('/tf', '', TF_TYPE, partial(poses_of, static=False))]


@dataclass(frozen=True, eq=False)
class ArmPose(TimedPose):
    """A pose of the flange by the values (joints,) of all joints of an arm (rad or m)."""

    joints: Array = field(default_factory=lambda: np.empty(0))


class OtherJointsError(UnusableMessageError):
    """A JointState without a joint of the arm, such as that of a gripper on the same topic."""


def pose_from_joints(arm: Arm, data: bytes) -> ArmPose:
    """
    Return the flange pose of an arm at a serialised JointState.

    Raises UnusableMessageError, for one of other joints alone OtherJointsError.
    """
    message = message_of(JOINTS_TYPE, data)
    names, positions = message.name, message.position.tolist()
    if len(positions) != len(names):
        raise UnusableMessageError(f'JointState message not used: it names {len(names)} '
                                   f'joints and holds {len(positions)} positions')
    try:
        joints = arm.joint_values(dict(zip(names, positions, strict=True)),
                                  'JointState message not used')
    except InputError as cause:
        is_other = all(joint.name not in names for joint in arm.joints)
        raise (OtherJointsError if is_other else UnusableMessageError)(str(cause)) from cause
    if not np.isfinite(joints).all():
        raise UnusableMessageError('JointState message not used: it holds positions that are not '
                                   'finite')
    T, = arm.forward(joints[None])
    return ArmPose(stamp_and_frame(message)[0], T[:3, 3], se3.quaternion(T), arm.base, joints)
