"""
The messages of an .mcap file, in its order, as far as they can be read.

rosbags and mcap read whole files only; a recording that was cut off (power, full disk) is
common, so the framing is read here, up to the damage, and says what was lost.
"""
from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache, partial
import io
from pathlib import Path
import struct
from typing import Any, BinaryIO
import zlib

from handeye_ros.ros.bags.blocks import Block, Gathered, unpacked_block
from handeye_ros.ros.bags.contents import Contents, full_name, message_of, type_of
from handeye_ros.ros.bags.mcap_records import (
    Bytes,
    chunk,
    DamagedError,
    FOOTER,
    frames,
    IN_CHUNK,
    MAGIC,
    MESSAGE,
    RECORD,
    record,
)
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

CHUNKS = 4  # that are kept unpacked: profiles of a stop lie close together


class McapFile:
    """Reads one .mcap file record by record."""

    def __init__(self, path: Path, name: str, contents: Contents, wanted: set[str] | None
                 ) -> None:
        """name: for the warnings; wanted: the topics whose messages are given, None: all."""
        self._path = path
        self._name = name
        self._contents = contents
        self._wanted = wanted
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, str] = {}  # those that are wanted
        self._known: set[int] = set()
        self._bad_chunks = 0
        self._count = 0
        self._chunk = lru_cache(CHUNKS)(self._unpacked_at)

    def pieces(self) -> Iterator[list[Block]]:
        """Yield the messages in the order of recording: pieces with a block for each topic."""
        complete, loose = False, Gathered(self._at)
        with suppress(DamagedError), self._path.open('rb') as stream:
            self._take_summary(stream)
            stream.seek(MAGIC)
            for opcode, body, whole, position in frames(stream):
                self._contents.at = position
                complete |= opcode in (Opcode.DATA_END, Opcode.FOOTER)
                if opcode == Opcode.FOOTER:
                    break
                if opcode == Opcode.CHUNK or loose.is_full:
                    yield loose.blocks()
                if opcode == Opcode.CHUNK:
                    yield self._of_chunk(body, whole, position)
                elif whole and opcode != Opcode.MESSAGE:
                    self._take(opcode, body)
                elif whole:
                    self._take_loose(body, position, loose)
        yield loose.blocks()
        self._tell(complete)

    def _tell(self, complete: bool) -> None:
        if self._bad_chunks:
            self._contents.warnings.append(
                f'{self._name} is damaged: {self._bad_chunks} chunk(s) of it were left out')
        if not complete:
            self._contents.warnings.append(f'{self._name} is cut off or damaged: read '
                                           f'{self._count} messages up to there')

    def _take_summary(self, stream: BinaryIO) -> None:
        """Take the channels that the end of a whole file repeats, in case its chunks are not."""
        try:
            size = stream.seek(0, io.SEEK_END)
            stream.seek(max(0, size - MAGIC - RECORD.size - FOOTER.size))
            opcode, _ = RECORD.unpack(stream.read(RECORD.size))
            start, *_ = FOOTER.unpack(stream.read(FOOTER.size))
            if opcode != Opcode.FOOTER or not 0 < start < size:
                return
            stream.seek(start)
            for opcode, body, whole, _ in frames(stream):
                if not whole or opcode == Opcode.FOOTER:
                    return
                self._take(opcode, body)
        except (struct.error, DamagedError):
            return

    def _of_chunk(self, body: bytes, whole: bool, position: int) -> list[Block]:
        """Return the messages of a chunk, or of its beginning where the file is cut in it."""
        found: dict[str, tuple[list[int], list[int], list[int]]] = {}
        data: Bytes = b''
        try:
            data, size, crc = chunk(body)
            if whole and (len(data) != size or crc and crc != zlib.crc32(data)):
                raise DamagedError
            self._find(data, found)
        except DamagedError:
            self._bad_chunks += 1
        again = partial(self._in_chunk, position, len(body))
        return [unpacked_block(Block(topic, data, starts, ends, times,
                                     list(zip(starts, ends, strict=True)), again))
                for topic, (starts, ends, times) in found.items()]

    def _find(self, data: Bytes, found: dict[str, tuple[list[int], list[int], list[int]]]
              ) -> None:
        """Note starts, ends and log times of the messages in an unpacked chunk, by topic."""
        place, end, unpack, channels = 0, len(data), IN_CHUNK.unpack_from, self._channels
        head, skipped, message = RECORD.size, MESSAGE.size, int(Opcode.MESSAGE)
        while place + head <= end:
            if place + head + skipped <= end:
                opcode, length, channel, _, log_time, _ = unpack(data, place)
            else:
                opcode, length = RECORD.unpack_from(data, place)
            start = place + head
            place = start + length
            if opcode == 0:
                return
            if place > end:
                continue
            if opcode != message:
                self._take(opcode, bytes(data[start:place]))
                continue
            if length < skipped:
                raise DamagedError
            self._count += 1
            if (topic := channels.get(channel)) is not None:
                starts, ends, log_times = found.setdefault(topic, ([], [], []))
                starts.append(start + skipped)
                ends.append(place)
                log_times.append(log_time)

    def _take_loose(self, body: bytes, position: int, loose: Gathered) -> None:
        """Take a message that lies in no chunk."""
        if len(body) < MESSAGE.size:
            raise DamagedError
        channel, _, log_time, _ = MESSAGE.unpack_from(body)
        self._count += 1
        if channel in self._channels:
            loose.add(self._channels[channel], log_time, body[MESSAGE.size:],
                      (position + MESSAGE.size, len(body) - MESSAGE.size))

    def _take(self, opcode: int, body: bytes) -> None:
        """Take a record that describes the messages."""
        if opcode == Opcode.SCHEMA:
            schema = record(Schema, body)
            self._schemas[schema.id] = schema.name
        elif opcode == Opcode.CHANNEL:
            self._take_channel(record(Channel, body))

    def _take_channel(self, channel: Any) -> None:
        topic = full_name(channel.topic)
        kind = self._schemas.get(channel.schema_id, 'of unknown type')
        self._contents.topics[topic] = type_of(kind, channel.message_encoding)
        if self._wanted is None or topic in self._wanted:
            self._channels[channel.id] = topic
        else:
            self._channels.pop(channel.id, None)

    # what gives a message again

    def _at(self, place: tuple[int, int]) -> bytes:
        return message_of(self._bytes(*place))

    def _in_chunk(self, position: int, size: int, place: tuple[int, int]) -> bytes:
        start, end = place
        return message_of(bytes(self._chunk(position, size)[start:end]))

    def _unpacked_at(self, position: int, size: int) -> Bytes:
        try:
            return chunk(self._bytes(position, size))[0]
        except DamagedError:  # the file is another by now
            return b''

    def _bytes(self, position: int, size: int) -> bytes:
        try:
            with self._path.open('rb') as stream:
                stream.seek(position)
                return stream.read(size)
        except OSError:  # nothing is no message of any type
            return b''
