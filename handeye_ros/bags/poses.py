"""
Flange poses of a topic of a bag as arrays: as reported, or of an arm at joint values.

The poses of one robot have the same layout, and those of a block are read at once: 26,500 of a bag
take 27 ms, and 270 ms if each is deserialised.
"""
from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
import math
import struct
from typing import overload

from handeye_ros import se3
from handeye_ros.bags.contents import Block, JOINTS
from handeye_ros.bags.messages import (
    deserialised,
    LARGEST_POSITION,
    LENGTH_TOLERANCE,
    pose_from_cdr,
    stamp_of,
)
from handeye_ros.bags.topic import Added, added_singly
from handeye_ros.data import Array, TimedPose
from handeye_ros.node.errors import MessageError
from handeye_ros.robot.model import Arm, JointNamesError
import numpy as np
from numpy.typing import NDArray

FRAME = 16  # position of the frame_id's characters in a serialised message
NUMBERS = 56  # bytes of a position and a quaternion
PADDING = 3  # bytes after a message at most


class PoseTable(Sequence[TimedPose]):
    """Poses in rows of numbers, with little memory for thousands per second."""

    def __init__(self, stamps: Sequence[int], rows: Array, frame: str,
                 joints: Array | None = None) -> None:
        """
        Keep the rows (n, 7) of position and quaternion x y z w; frame: the parent of all.

        joints: the joint values (n, joints) of the poses.
        """
        self._stamps = array('q', stamps)
        self._rows = rows
        self._frame = frame
        self.joints = joints

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self._stamps)

    @overload
    def __getitem__(self, index: int) -> TimedPose: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[TimedPose]: ...

    def __getitem__(self, index: int | slice) -> TimedPose | Sequence[TimedPose]:
        """Return a pose, or some."""
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        row = self._rows[index]
        return TimedPose(self._stamps[index], row[:3], row[3:], self._frame)

    def __iter__(self) -> Iterator[TimedPose]:
        """Yield the poses in their order."""
        return (self[index] for index in range(len(self)))


class Poses:
    """Reported poses; frames: the first two of their parents."""

    def __init__(self) -> None:
        """Start with none."""
        self._rows = array('d')
        self.frames: list[str] = []

    def add(self, block: Block) -> Added:
        """Add the next messages."""
        stamps, rows, good, frame = _read_alike(block)
        frames, reason = [frame] if good.any() else [], ''
        for index in np.flatnonzero(~good).tolist():
            try:
                pose = pose_from_cdr(block.message(index))
            except MessageError as error:
                reason = reason or str(error)
            else:
                stamps[index], good[index] = pose.stamp, True
                rows[index] = *pose.translation, *pose.quaternion
                frames.append(pose.parent_frame)
        self.frames = list(dict.fromkeys(self.frames + frames))[:2]
        self._rows.frombytes(rows[good].tobytes())
        return Added(stamps[good].tolist(), np.flatnonzero(good).tolist(), reason)

    def chosen(self, order: Sequence[int], stamps: Sequence[int]) -> PoseTable:
        """Return poses in an order, with stamps."""
        rows = np.frombuffer(self._rows, float).reshape(-1, 7)[np.array(order, int)]
        return PoseTable(stamps, rows, self.frames[0])


def _read_alike(block: Block) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_], str]:
    """
    Return stamps (n,), poses (n, 7), which of them (n,) are read, and their frame.

    Only valid poses with the layout and frame of the first message are read.
    """
    starts, ends = np.array(block.starts), np.array(block.ends)
    data = np.frombuffer(block.data, np.uint8)
    first = bytes(data[starts[0]:ends[0]])
    unread = (np.zeros(len(block), np.int64), np.zeros((len(block), 7)),
              np.zeros(len(block), bool), '')
    try:
        frame = pose_from_cdr(first).parent_frame
    except MessageError:
        return unread
    frame_end = FRAME + struct.unpack_from('<I', first, FRAME - 4)[0]
    numbers_start = frame_end + (4 - frame_end) % 8  # aligned to 8 after the encapsulation header
    if first[:2] != b'\0\1' or len(first) > numbers_start + NUMBERS + PADDING:
        return unread
    good = ends - starts == len(first)
    rows = data[np.where(good, starts, starts[0])[:, None] + np.arange(len(first))]
    good &= (rows[:, :2] == rows[0, :2]).all(axis=1)  # the encoding
    good &= (rows[:, 12:frame_end] == rows[0, 12:frame_end]).all(axis=1)  # the frame_id
    values = rows.view(np.dtype({'names': ['sec', 'nanosec', 'pose'],
                                 'offsets': [4, 8, numbers_start],
                                 'formats': ['<i4', '<u4', '(7,)<f8'], 'itemsize': len(first)}))
    stamps = values['sec'].astype(np.int64) * 1_000_000_000 + values['nanosec']
    poses, usable = _normalised(np.ascontiguousarray(values['pose'][:, 0]))
    return stamps[:, 0], poses, good & usable, frame


def _normalised(rows: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return poses with unit quaternions and qw >= 0, and which of them are valid."""
    # math.hypot as for a single pose: numpy rounds differently
    norm = np.array(list(map(math.hypot, *rows[:, 3:].T.tolist())))
    farthest = np.abs(rows[:, :3]).max(axis=1)
    with np.errstate(all='ignore'):
        good = (np.isfinite(rows).all(axis=1) & (farthest <= LARGEST_POSITION)
                & (np.abs(norm - 1.0) <= LENGTH_TOLERANCE))
        scale = np.where(rows[:, 6] < 0, -1.0, 1.0) / norm
        return np.hstack([rows[:, :3], rows[:, 3:] * scale[:, None]]), good


class JointPoses:
    """Joint values as the poses of an arm; frames: that of its base."""

    def __init__(self, arm: Arm) -> None:
        """Start with none."""
        self._arm, self._rows = arm, array('d')
        self.frames = [arm.chain.base]

    def add(self, block: Block) -> Added:
        """Add the next messages."""
        def one(index: int) -> int:
            stamp, values = _joint_values(self._arm, block.message(index))
            self._rows.extend(values)
            return stamp

        return added_singly(block, one)

    def chosen(self, order: Sequence[int], stamps: Sequence[int]) -> PoseTable:
        """Return the poses in an order, with stamps."""
        rows = np.frombuffer(self._rows, float).reshape(-1, len(self._arm.chain.measured))
        joints, T = _forward(self._arm, rows[np.array(order, int)])
        return PoseTable(stamps, np.hstack([T[:, :3, 3], se3.quaternion(T)]), self.frames[0],
                         joints)


def pose_from_joints(arm: Arm, data: bytes) -> TimedPose:
    """Return the flange pose of an arm at a serialised JointState; raises MessageError."""
    return joints_and_pose(arm, data)[1]


def joints_and_pose(arm: Arm, data: bytes) -> tuple[Array, TimedPose]:
    """Return the joint values (joints,) of a JointState, and the flange pose; MessageError."""
    stamp, values = _joint_values(arm, data)
    joints, T = _forward(arm, np.array([values]))
    return joints[0], TimedPose(stamp, T[0, :3, 3], se3.quaternion(T[0]), arm.chain.base)


def _forward(arm: Arm, values: Array) -> tuple[Array, Array]:
    """Return all joints (n, joints) and T_base_flange (n, 4, 4) by the measured joints (n, m)."""
    joints = arm.chain.values(dict(zip(arm.chain.measured, values.T, strict=True)), JOINTS)
    return joints, arm.forward(joints)


def _joint_values(arm: Arm, data: bytes) -> tuple[int, list[float]]:
    """Return the stamp and the values of the measured joints of an arm; raises MessageError."""
    state = deserialised(data, JOINTS)
    if len(state.position) != len(state.name):
        raise MessageError('JointState', f'it names {len(state.name)} joints and holds '
                           f'{len(state.position)} positions')
    positions = dict(zip(state.name, state.position.tolist(), strict=True))
    try:
        values = [positions[name] for name in arm.chain.measured]
    except KeyError as error:
        cause = JointNamesError.missing('the message', error.args[0], list(positions))
        raise MessageError('JointState', str(cause)) from error
    if not all(map(math.isfinite, values)):
        raise MessageError('JointState', 'it holds positions that are not finite')
    return stamp_of(state.header), values
