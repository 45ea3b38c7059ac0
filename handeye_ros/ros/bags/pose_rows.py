"""
The poses of a block of messages, read at once.

Those of one robot are laid out alike, as the frame_id is the same; what is not like the first
one, or cannot be used, is left for messages.py to read, or to refuse with a reason.
"""
from __future__ import annotations

import math
from typing import Any, NamedTuple

from handeye_ros.data import Array
from handeye_ros.ros.bags import cdr
from handeye_ros.ros.bags.blocks import Block
from handeye_ros.ros.bags.messages import frame_name, LARGEST_POSITION, LENGTH_TOLERANCE
from handeye_ros.ros.errors import MessageError
import numpy as np
from numpy.typing import NDArray

SEC, NANOSEC = slice(4, 8), slice(8, 12)  # where the parts of a stamp lie in a message
NUMBERS = 56  # bytes of a position and a quaternion


class PoseRows(NamedTuple):
    """
    Poses in rows: stamps (n,) ns, rows (n, 7) x y z, qx qy qz qw; frame: the parent of all.

    good: (n,) which of them were read, the others hold anything.
    """

    stamps: NDArray[np.int64]
    rows: Array
    good: NDArray[np.bool_]
    frame: str


def pose_rows(block: Block) -> PoseRows:
    """Return what the messages of a block that are laid out as its first one say."""
    found = PoseRows(np.zeros(len(block), np.int64), np.zeros((len(block), 7)),
                     np.zeros(len(block), bool), '')
    first = block.message(0)
    try:
        head, end = cdr.header(first, 'PoseStamped')
    except MessageError:
        return found
    begin = cdr.aligned(end, 8)
    if len(first) < begin + NUMBERS or cdr.byte_order(first, 'PoseStamped') != '<':
        return found
    table, good = _table(block, len(first))
    same = [0, 1, *range(NANOSEC.stop, end)]  # the encoding and the frame_id
    good &= (table[:, same] == table[0, same]).all(axis=1)
    stamps = (_as(table[:, SEC], '<i4')[:, 0].astype(np.int64) * 1_000_000_000
              + _as(table[:, NANOSEC], '<u4')[:, 0].astype(np.int64))
    rows, usable = _normalised(_as(table[:, begin:begin + NUMBERS], '<f8'))
    return PoseRows(stamps, rows, good & usable, frame_name(head.frame_id))


def _table(block: Block, length: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return the bytes of the messages (n, length), and which of them have this length."""
    starts = np.array(block.starts)
    fits = np.array(block.ends) - starts == length
    data = np.frombuffer(block.data, np.uint8)
    return data[np.where(fits, starts, starts[0])[:, None] + np.arange(length)], fits


def _as(table: NDArray[np.uint8], kind: str) -> NDArray[Any]:
    """Return columns of bytes as numbers."""
    return np.ascontiguousarray(table).view(kind)


def _normalised(rows: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return poses with quaternions of unit length and qw >= 0, and which of them are poses."""
    # as for a single one: numpy rounds otherwise
    norm = np.array(list(map(math.hypot, *rows[:, 3:].T.tolist())))
    farthest = np.abs(rows[:, :3]).max(axis=1)
    with np.errstate(all='ignore'):
        good = (np.isfinite(rows).all(axis=1) & (farthest <= LARGEST_POSITION)
                & (np.abs(norm - 1.0) <= LENGTH_TOLERANCE))
        scale = np.where(rows[:, 6] < 0, -1.0, 1.0) / norm
        return np.hstack([rows[:, :3], rows[:, 3:] * scale[:, None]]), good
