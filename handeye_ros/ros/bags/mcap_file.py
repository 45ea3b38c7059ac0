"""
The records of an .mcap file, one after the other, as far as they can be read.

rosbags and mcap read whole files only; a recording that was cut off (power, full disk) is
common, so the framing is read here, up to the damage, and says what was lost. No length that a
file claims is believed: nothing larger than LARGEST is ever held.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache, partial
import io
from pathlib import Path
import struct
from typing import Any, BinaryIO
import zlib

from handeye_ros.ros.bags.contents import (
    Contents,
    full_name,
    Given,
    LARGEST,
    message_of,
    Raw,
    type_of,
    unpacked,
)
import lz4.frame  # type: ignore[import-untyped]
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema

FOOTER = struct.Struct('<QQI')  # what it holds: start of the summary, of its offsets, crc
RECORD = struct.Struct('<BQ')
MESSAGE = struct.Struct('<HIQQ')
CHUNKS = 4  # that are kept unpacked: profiles of a stop lie close together
MAGIC = 8  # bytes at either end


class DamagedError(Exception):
    """A record is not what it says it is."""


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

    def messages(self) -> Iterator[Given]:
        """Yield the messages in the order of recording, each with what gives it again."""
        complete = False
        with suppress(DamagedError), self._path.open('rb') as stream:
            self._take_summary(stream)
            stream.seek(MAGIC)
            for opcode, body, whole, position in _frames(stream):
                self._contents.at = position
                complete |= opcode in (Opcode.DATA_END, Opcode.FOOTER)
                if opcode == Opcode.FOOTER:
                    break
                if opcode == Opcode.CHUNK:
                    yield from self._of_chunk(body, whole, position)
                elif whole and opcode != Opcode.MESSAGE:
                    self._take(opcode, body)
                elif whole and (raw := self._message(body, 0, len(body))):
                    yield raw, partial(self._at, position + MESSAGE.size,
                                       len(body) - MESSAGE.size)
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
            for opcode, body, whole, _ in _frames(stream):
                if not whole or opcode == Opcode.FOOTER:
                    return
                self._take(opcode, body)
        except (struct.error, DamagedError):
            return

    def _of_chunk(self, body: bytes, whole: bool, position: int) -> Iterator[Given]:
        """Yield the messages of a chunk, or of its beginning where the file is cut in it."""
        try:
            chunk, data = _chunk(body)
            crc = chunk.uncompressed_crc
            if whole and (len(data) != chunk.uncompressed_size or crc and crc != zlib.crc32(data)):
                self._bad_chunks += 1
                return
            yield from self._of_records(data, position, len(body))
        except DamagedError:
            self._bad_chunks += 1

    def _of_records(self, data: bytes, position: int, size: int) -> Iterator[Given]:
        """Yield the messages of an unpacked chunk; position, size: of it in the file."""
        place, end = 0, len(data)
        while place + RECORD.size <= end:
            opcode, length = RECORD.unpack_from(data, place)
            start = place + RECORD.size
            place = start + length
            if opcode == 0:
                return
            if place > end:
                continue
            if opcode != Opcode.MESSAGE:
                self._take(opcode, data[start:place])
            elif raw := self._message(data, start, place):
                yield raw, partial(self._in_chunk, position, size, start + MESSAGE.size, place)

    def _message(self, data: bytes, start: int, end: int) -> Raw | None:
        """Return the message that data[start:end] holds, if it is wanted."""
        if end - start < MESSAGE.size:
            raise DamagedError
        channel, _, log_time, _ = MESSAGE.unpack_from(data, start)
        self._count += 1
        topic = self._channels.get(channel)
        if topic is None:
            return None
        return Raw(topic, log_time, message_of(data[start + MESSAGE.size:end]))

    def _take(self, opcode: int, body: bytes) -> None:
        """Take a record that describes the messages."""
        if opcode == Opcode.SCHEMA:
            schema = _record(Schema, body)
            self._schemas[schema.id] = schema.name
        elif opcode == Opcode.CHANNEL:
            self._take_channel(_record(Channel, body))

    def _take_channel(self, channel: Any) -> None:
        topic = full_name(channel.topic)
        kind = self._schemas.get(channel.schema_id, 'of unknown type')
        self._contents.topics[topic] = type_of(kind, channel.message_encoding)
        if self._wanted is None or topic in self._wanted:
            self._channels[channel.id] = topic
        else:
            self._channels.pop(channel.id, None)

    # what gives a message again

    def _at(self, position: int, size: int) -> bytes:
        return message_of(self._bytes(position, size))

    def _in_chunk(self, position: int, size: int, start: int, end: int) -> bytes:
        return message_of(self._chunk(position, size)[start:end])

    def _unpacked_at(self, position: int, size: int) -> bytes:
        try:
            return _chunk(self._bytes(position, size))[1]
        except DamagedError:  # the file is another by now
            return b''

    def _bytes(self, position: int, size: int) -> bytes:
        try:
            with self._path.open('rb') as stream:
                stream.seek(position)
                return stream.read(size)
        except OSError:  # nothing is no message of any type
            return b''


def _frames(stream: BinaryIO) -> Iterator[tuple[int, bytes, bool, int]]:
    """
    Yield the opcode and body of each record, whether it is whole, and where it begins.

    Opcode 0, and a length that no recorder writes, is damage.
    """
    wanted = (Opcode.MESSAGE, Opcode.CHUNK, Opcode.SCHEMA, Opcode.CHANNEL)
    while len(head := stream.read(RECORD.size)) == RECORD.size:
        opcode, length = RECORD.unpack(head)
        position = stream.tell()
        if opcode == 0 or length > LARGEST:
            return
        if opcode in wanted:
            body = stream.read(length)
            yield opcode, body, len(body) == length, position
        else:
            yield opcode, b'', True, position
            stream.seek(position + length)


def _record(kind: Any, body: bytes) -> Any:
    return _parsed(kind.read, ReadDataStream(io.BytesIO(body)))


def _parsed(parse: Callable[..., Any], *args: Any) -> Any:
    """Return what a parser returns; raises DamagedError whatever the parser raises."""
    try:
        return parse(*args)
    except Exception as error:  # damaged bytes lead parsers to errors of all kinds
        raise DamagedError from error


def _chunk(body: bytes) -> tuple[Any, bytes]:
    """Return a chunk and its records, also of the beginning of one; raises DamagedError."""
    chunk = _record(Chunk, body)
    if chunk.compression == '':
        return chunk, chunk.data
    unpack = {'zstd': unpacked, 'lz4': _unpacked_lz4}.get(chunk.compression)
    if unpack is None:
        raise DamagedError
    return chunk, _parsed(unpack, chunk.data)


def _unpacked_lz4(data: bytes) -> bytes:
    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=LARGEST))
