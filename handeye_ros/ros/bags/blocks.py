"""
The messages of a bag as they lie in it, many at a time.

Thousands come a second: what is done once for a block of them costs little for each.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from typing import Any

from handeye_ros.ros.bags.contents import Given, message_of, Raw, ZSTD
import numpy as np

MOST = 256  # single messages that are gathered to blocks, and
MOST_BYTES = 1 << 22  # how many bytes of them


@dataclass(frozen=True, eq=False)
class Block:
    """
    Messages of one topic, in the order of recording.

    data: what they lie in, each from one of starts to the same of ends; log_times: ns. again
    gives a message once more, by what places tells of it, so that it need not be kept: nothing,
    where it is lost meanwhile.
    """

    topic: str
    data: bytes | memoryview
    starts: Sequence[int]
    ends: Sequence[int]
    log_times: Sequence[int]
    places: Sequence[Any]
    again: Callable[[Any], bytes]

    def __len__(self) -> int:
        """Return how many messages there are."""
        return len(self.starts)

    def message(self, index: int) -> bytes:
        """Return a message."""
        return bytes(self.data[self.starts[index]:self.ends[index]])

    def given(self, index: int) -> Given:
        """Return a message with what gives it again."""
        return (Raw(self.topic, self.log_times[index], self.message(index)),
                partial(self.again, self.places[index]))


def block_of(topic: str, log_times: Sequence[int], messages: Sequence[bytes],
             places: Sequence[Any], again: Callable[[Any], bytes]) -> Block:
    """Return messages as a block."""
    ends = list(accumulate(map(len, messages)))
    return Block(topic, b''.join(messages), [0, *ends[:-1]], ends, log_times, places, again)


def unpacked_block(block: Block) -> Block:
    """Return a block with the messages unpacked that the recorder packed."""
    if not len(block.data):
        return block
    data = np.frombuffer(block.data, np.uint8)
    if not (data[np.minimum(block.starts, len(data) - 1)] == ZSTD[0]).any():
        return block
    messages = [message_of(block.message(index)) for index in range(len(block))]
    return block_of(block.topic, block.log_times, messages, block.places, block.again)


def in_recorded_order(blocks: Sequence[Block]) -> Iterator[Given]:
    """Yield the messages of the topics in one piece of a bag, in the order of recording."""
    order = sorted((place, number, index) for number, block in enumerate(blocks)
                   for index, place in enumerate(block.places))
    return (blocks[number].given(index) for _, number, index in order)


class Gathered:
    """Single messages, gathered to blocks."""

    def __init__(self, again: Callable[[Any], bytes]) -> None:
        """Start with none; again: gives a message by its place."""
        self._again = again
        self._found: dict[str, tuple[list[int], list[bytes], list[Any]]] = {}
        self._count = self._bytes = 0

    @property
    def is_full(self) -> bool:
        """Tell whether enough are gathered."""
        return self._count >= MOST or self._bytes >= MOST_BYTES

    def add(self, topic: str, log_time: int, data: bytes, place: Any) -> None:
        """Take the next message."""
        log_times, messages, places = self._found.setdefault(topic, ([], [], []))
        log_times.append(log_time)
        messages.append(message_of(data))
        places.append(place)
        self._count += 1
        self._bytes += len(data)

    def blocks(self) -> list[Block]:
        """Return what was gathered, and forget it."""
        blocks = [block_of(topic, *lists, self._again) for topic, lists in self._found.items()]
        self._found, self._count, self._bytes = {}, 0, 0
        return blocks
