"""
The messages of one topic of a bag: which are valid, and their order.

Little memory is used, so that hours fit: of a profile its stamp and its position in the file.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Generic, NamedTuple, Protocol, TypeVar

from handeye_ros.bags.contents import Block, Contents, full_name
from handeye_ros.bags.profile_reader import ProfileReader, split
from handeye_ros.config import ProfileConfig
from handeye_ros.data import RawProfile
from handeye_ros.errors import BagError
from handeye_ros.node.errors import AllMalformedError, MessageError, NoTopicError, TopicTypeError
from handeye_ros.sampling.stream import in_order, LARGEST_STEP, never_falls
from handeye_ros.sampling.stream_errors import TimeBackwardsError

LAST = 2 ** 63 - 1  # ns; largest stamp

Item = TypeVar('Item', covariant=True)


class Added(NamedTuple):
    """Result of a block: stamps and indices of its valid messages, why others are invalid."""

    stamps: list[int]
    used: Sequence[int]
    reason: str = ''


class Store(Protocol[Item]):
    """Storage of the items of a topic; each can be returned with another stamp."""

    def add(self, block: Block) -> Added:
        """Add the next messages."""

    def chosen(self, order: Sequence[int], stamps: Sequence[int]) -> Sequence[Item]:
        """Return items in an order, with stamps."""


def added_singly(block: Block, take: Callable[[int], int]) -> Added:
    """Return the result of a block; take: adds message i, returns its stamp; MessageError."""
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
    """Profiles, decoded on demand."""

    def __init__(self, config: ProfileConfig) -> None:
        """Start with none; config: describes the clouds."""
        self._reader = ProfileReader(config)
        self._items: list[RawProfile] = []

    def add(self, block: Block) -> Added:
        """Add the next messages."""
        def one(index: int) -> int:
            item = self._reader.take(block.message(index),
                                     partial(block.reread, block.positions[index]))
            self._items.append(item)
            return item.stamp

        return added_singly(block, one)

    def chosen(self, order: Sequence[int], stamps: Sequence[int]) -> tuple[RawProfile, ...]:
        """Return profiles in an order, with stamps: one for each row of their messages."""
        profiles: list[RawProfile] = []
        for index, stamp, previous in zip(order, stamps, (None, *stamps), strict=False):
            item = self._items[index]
            item = item if item.stamp == stamp else replace(item, stamp=stamp)
            profiles += split(item, previous, item.config)
        return tuple(profiles)


class Topic(Generic[Item]):
    """Receives the messages of a topic in recording order; returns its items."""

    def __init__(self, key: str, name: str, kind: str, store: Store[Item]) -> None:
        """key: of the configuration, that names the topic; kind: the type it must have."""
        self.name = full_name(name)
        self._key = key
        self._kind = kind
        self._store = store
        self._stamps: list[int] = []
        self._log_times: list[int] = []
        self._malformed = 0
        self._first_reason = ''

    def take(self, block: Block) -> None:
        """Add the next messages; malformed ones are counted."""
        added = self._store.add(block)
        self._stamps += added.stamps
        self._log_times += [min(block.log_times[index], LAST) for index in added.used]
        self._malformed += len(block) - len(added.used)
        self._first_reason = self._first_reason or added.reason

    def items(self, path: Path, contents: Contents) -> Sequence[Item]:
        """
        Return the items of the messages in the order of their stamps.

        contents: of the bag at path; left out and repaired messages are added to its warnings.
        Raises NoTopicError, TopicTypeError, BagError, AllMalformedError or TimeBackwardsError.
        """
        self.require(path, contents)
        if self._stamps[0] > 0 and never_falls(self._stamps):
            return self._store.chosen(range(len(self._stamps)), self._stamps)
        order = self._as_received(contents)
        stamps, order = self._stamped(order, contents)
        order = sorted(in_their_order(self.name, [(stamps[i], i) for i in order], contents),
                       key=stamps.__getitem__)
        return self._store.chosen(order, [stamps[i] for i in order])

    def require(self, path: Path, contents: Contents, may_be_empty: bool = False) -> None:
        """Raise for a missing topic, and if most of its messages are invalid."""
        require_topic(path, contents, self._key, self.name, self._kind)
        good, bad = len(self._stamps), self._malformed
        if not good + bad and not may_be_empty:
            raise BagError(path, f'no messages on {self.name} ({self._kind}): check that it was '
                           f'published while recording, or set {self._key}')
        if bad > good:
            raise AllMalformedError(self.name, bad, good + bad, self._first_reason)
        if bad:
            contents.warnings.append(f'{bad} of {good + bad} messages on {self.name} were left '
                                     f'out; the first: {self._first_reason}')

    def _as_received(self, contents: Contents) -> list[int]:
        """
        Return messages in the order received, if they are stored in another order.

        The order in the file has priority: two consecutive runs of a simulated clock have the same
        times of receipt, and must not be merged into one.
        """
        stamps = self._stamps
        stored_order = list(range(len(stamps)))
        received_order = sorted(stored_order, key=self._log_times.__getitem__)
        if (received_order == stored_order or in_order(stamps)
                or not in_order([stamps[i] for i in received_order])
                or len(set(stamps)) < len(stamps)):
            return stored_order
        contents.warnings.append(f'the messages on {self.name} do not lie in the order in which '
                                 'they were received, and were sorted')
        return received_order

    def _stamped(self, order: list[int], contents: Contents) -> tuple[list[int], list[int]]:
        """Return stamps, and which messages have one; if none has, the times of receipt."""
        stamped = [index for index in order if self._stamps[index] != 0]
        if len(stamped) == len(order):
            return self._stamps, order
        if stamped:
            contents.warnings.append(f'{len(order) - len(stamped)} messages on {self.name} '
                                     'without a stamp were left out')
            return self._stamps, stamped
        contents.warnings.append(f'the messages on {self.name} have no stamps; the times at '
                                 'which they were recorded are used')
        return self._log_times, order


def require_topic(path: Path, contents: Contents, key: str, name: str, kind: str) -> None:
    """Raise for a bag without a topic of this name and type; key: that names it."""
    if name not in contents.topics:
        raise NoTopicError(path, key, name, kind, contents.topics)
    if contents.topics[name] != kind:
        raise TopicTypeError(key, name, kind, contents.topics)


def in_their_order(topic: str, stamped: Sequence[tuple[int, Item]], contents: Contents
                   ) -> list[Item]:
    """Return which items fit the order of stamps; raises TimeBackwardsError."""
    stamps = [stamp for stamp, _ in stamped]
    fits = in_order(stamps)
    if fits is None:
        raise TimeBackwardsError(topic, *_first_jump_back(stamps))
    wrong = [index for index, fitting in enumerate(fits) if not fitting]
    if wrong:
        contents.warnings.append(
            f'{len(wrong)} of {len(stamps)} messages on {topic} were left out: their stamps '
            f'are far from those around them (first message {wrong[0] + 1}, of '
            f'{stamps[wrong[0]] * 1e-9:.3f} s)')
    return [item for (_, item), fitting in zip(stamped, fits, strict=True) if fitting]


def _first_jump_back(stamps: Sequence[int]) -> tuple[int, float]:
    """Return the index after the first jump back, and its size in seconds."""
    for index, latest in enumerate(accumulate(stamps, max)):
        if latest - stamps[index] > LARGEST_STEP:
            return index, (latest - stamps[index]) * 1e-9
    raise ValueError('the stamps never jump back')
