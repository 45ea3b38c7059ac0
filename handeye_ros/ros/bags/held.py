"""
What is held of the messages of a topic of a bag: as little as can be, so that hours fit.

Of a profile its stamp is held and where it lies, of a pose its numbers.
"""
from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, overload, Protocol, TypeVar

from handeye_ros.data import RawProfile, TimedPose
from handeye_ros.ros.bags.batches import split
from handeye_ros.ros.bags.blocks import Block
from handeye_ros.ros.bags.messages import pose_numbers
from handeye_ros.ros.bags.pose_rows import pose_rows
from handeye_ros.ros.errors import MessageError
import numpy as np

Item = TypeVar('Item', covariant=True)


class Added(NamedTuple):
    """What a block gave: stamps of its messages that can be used, which, and why not others."""

    stamps: list[int]
    used: Sequence[int]
    reason: str = ''


class Store(Protocol[Item]):
    """Where the items of a topic are held; each can be had with another stamp."""

    def add(self, block: Block) -> Added:
        """Take the next messages."""

    def chosen(self, order: Sequence[int], stamps: Sequence[int]) -> Sequence[Item]:
        """Return items in an order, with stamps."""


def one_by_one(block: Block, take: Callable[[int], int]) -> Added:
    """Return what a block gives; take: a message by its index, gives its stamp; MessageError."""
    stamps, used, reason = [], [], ''
    for index in range(len(block)):
        try:
            stamps.append(take(index))
        except MessageError as error:
            reason = reason or str(error)
        else:
            used.append(index)
    return Added(stamps, used, reason)


class Profiles:
    """Profiles, to be read where they are used."""

    def __init__(self, take: Callable[..., RawProfile]) -> None:
        """Start with none; take: makes one of a message and of what reads it again."""
        self._take = take
        self._items: list[RawProfile] = []

    def add(self, block: Block) -> Added:
        """Take the next messages."""
        def one(index: int) -> int:
            item = self._take(block.message(index), partial(block.again, block.places[index]))
            self._items.append(item)
            return item.stamp

        return one_by_one(block, one)

    def chosen(self, order: Sequence[int], stamps: Sequence[int]) -> tuple[RawProfile, ...]:
        """Return profiles in an order, with stamps: one for each row of their messages."""
        found: list[RawProfile] = []
        for index, stamp, before in zip(order, stamps, (None, *stamps), strict=False):
            item = self._items[index]
            item = item if item.stamp == stamp else replace(item, stamp=stamp)
            if item.rows == 1:
                found.append(item)
            else:
                found += split(item, before, item.config)
        return tuple(found)


class PoseTable(Sequence[TimedPose]):
    """Poses in rows of numbers: thousands a second take little of the memory so."""

    def __init__(self, stamps: Sequence[int], rows: np.ndarray[Any, Any],
                 frame: str) -> None:
        """rows: (n, 7) position and quaternion x y z w; frame: the parent of all."""
        self._stamps = array('q', stamps)
        self._rows = rows
        self._frame = frame

    def __len__(self) -> int:
        """Return how many there are."""
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
    """Poses, held as numbers; frames: the first two of their parents."""

    def __init__(self) -> None:
        """Start with none."""
        self._rows = array('d')
        self.frames: list[str] = []

    def add(self, block: Block) -> Added:
        """Take the next messages."""
        found, reason = pose_rows(block), ''
        if found.good.any():
            self._note(found.frame)
        for index in np.flatnonzero(~found.good).tolist():
            try:
                stamp, frame, numbers = pose_numbers(block.message(index))
            except MessageError as error:
                reason = reason or str(error)
            else:
                found.stamps[index], found.rows[index], found.good[index] = stamp, numbers, True
                self._note(frame)
        self._rows.frombytes(found.rows[found.good].tobytes())
        return Added(found.stamps[found.good].tolist(), np.flatnonzero(found.good).tolist(),
                     reason)

    def _note(self, frame: str) -> None:
        if len(self.frames) < 2 and frame not in self.frames:
            self.frames.append(frame)

    def chosen(self, order: Sequence[int], stamps: Sequence[int]) -> PoseTable:
        """Return poses in an order, with stamps."""
        rows = np.frombuffer(self._rows, float).reshape(-1, 7)[np.array(order, int)]
        return PoseTable(stamps, rows, self.frames[0])
