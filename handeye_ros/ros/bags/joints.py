"""Joint values out of a bag, and the flange poses that an arm has at them."""
from __future__ import annotations

from array import array
from collections.abc import Sequence
import math
import struct

from handeye_ros import se3
from handeye_ros.data import Array, TimedPose
from handeye_ros.kinematics.errors import JointNamesError
from handeye_ros.kinematics.model import Arm
from handeye_ros.ros.bags import cdr
from handeye_ros.ros.bags.blocks import Block
from handeye_ros.ros.bags.held import Added, one_by_one, PoseTable
from handeye_ros.ros.errors import MessageError
import numpy as np

KIND = 'JointState'
MOST_NAMES = 1000  # a count that damage made absurd must not become a loop


def joint_state(data: bytes) -> tuple[int, dict[str, float]]:
    """Return the stamp (ns) and the positions of a serialised JointState; raises MessageError."""
    head, at = cdr.header(data, KIND)
    order = cdr.byte_order(data, KIND)
    try:
        names, at = [], cdr.aligned(at, 4)
        (count,), at = struct.unpack_from(f'{order}I', data, at), at + 4
        for _ in range(min(count, MOST_NAMES)):
            at = cdr.aligned(at, 4)
            (length,), at = struct.unpack_from(f'{order}I', data, at), at + 4
            names.append(data[at:at + length].rstrip(b'\0').decode())
            at += length
        at = cdr.aligned(at, 4)
        (count,), at = struct.unpack_from(f'{order}I', data, at), cdr.aligned(at + 4, 8)
        values = struct.unpack_from(f'{order}{min(count, MOST_NAMES)}d', data, at)
    except (struct.error, UnicodeDecodeError) as error:
        raise MessageError(KIND, f'damaged message: {error}') from error
    return head.stamp, positions(names, values)


def positions(names: Sequence[str], values: Sequence[float]) -> dict[str, float]:
    """Return the positions of a JointState by the names of the joints; raises MessageError."""
    if len(values) != len(names):
        raise MessageError(KIND, f'it names {len(names)} joints and holds {len(values)} positions')
    return dict(zip(names, map(float, values), strict=True))


def values_of(arm: Arm, given: dict[str, float]) -> list[float]:
    """Return the values of the joints that an arm needs; raises MessageError."""
    try:
        found = [given[name] for name in arm.chain.measured]
    except KeyError as error:
        cause = JointNamesError.missing('the message', error.args[0], list(given))
        raise MessageError(KIND, str(cause)) from error
    if not all(map(math.isfinite, found)):
        raise MessageError(KIND, 'it holds positions that are not finite')
    return found


def pose_from_joints(arm: Arm, data: bytes) -> TimedPose:
    """Return the flange pose of an arm at a serialised JointState; raises MessageError."""
    return joints_and_pose(arm, data)[1]


def joints_and_pose(arm: Arm, data: bytes) -> tuple[Array, TimedPose]:
    """Return joint values (joints,) too."""
    stamp, given = joint_state(data)
    values = dict(zip(arm.chain.measured, values_of(arm, given), strict=True))
    q = arm.chain.values({name: np.array([value]) for name, value in values.items()}, KIND)
    T = arm.forward(q)[0]
    return q[0], TimedPose(stamp, T[:3, 3], se3.quaternion(T), arm.chain.base)


class JointTable(PoseTable):
    """Flange poses with the joint values (n, joints) that they follow from."""

    joints: Array


class JointPoses:
    """Joint values, held as numbers, given as the poses of an arm; frames: that of its base."""

    def __init__(self, arm: Arm) -> None:
        """Start with none."""
        self._arm, self._rows = arm, array('d')
        self.frames = [arm.chain.base]

    def add(self, block: Block) -> Added:
        """Take the next messages."""
        def one(index: int) -> int:
            stamp, given = joint_state(block.message(index))
            self._rows.extend(values_of(self._arm, given))
            return stamp

        return one_by_one(block, one)

    def chosen(self, order: Sequence[int], stamps: Sequence[int]) -> JointTable:
        """Return the poses in an order, with stamps."""
        chain = self._arm.chain
        rows = np.frombuffer(self._rows, float).reshape(-1, len(chain.measured))
        given = dict(zip(chain.measured, rows[np.array(order, int)].T, strict=True))
        joints = chain.values(given, KIND)
        T = self._arm.forward(joints)
        table = JointTable(stamps, np.hstack([T[:, :3, 3], se3.quaternion(T)]), self.frames[0])
        table.joints = joints
        return table
