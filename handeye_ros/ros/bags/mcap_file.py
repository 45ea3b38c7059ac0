"""
The records of an .mcap file, as far as they can be read.

rosbags and mcap read whole files only; a recording that was cut off (power, full disk) is
common, so the framing is read here, up to the damage, and says what was lost.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
import io
from pathlib import Path
import struct
from typing import Any, BinaryIO
import zlib

from handeye_ros.ros.bags.contents import Contents, full_name, message_of, Raw, type_of
import lz4.frame  # type: ignore[import-untyped]
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
import zstandard

PIECE = 1 << 24  # a length that damage made absurd must not become an allocation


class DamagedError(Exception):
    """A record is not what it says it is."""


class McapFile:
    """Reads one .mcap file record by record."""

    def __init__(self, path: Path, contents: Contents, wanted: set[str] | None) -> None:
        """wanted: the topics whose messages are put into the contents; None: all."""
        self._path = path
        self._contents = contents
        self._wanted = wanted
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, str] = {}
        self._messages: list[tuple[int, int, bytes]] = []
        self._bad_chunks = 0

    def scan(self, stream: BinaryIO) -> None:
        """Take all records behind the magic."""
        complete = self._take_all(stream)
        # only now: where a damaged chunk defines the channels, the summary repeats them
        for channel, log_time, data in self._messages:
            topic = self._channels.get(channel)
            if topic is not None and (self._wanted is None or topic in self._wanted):
                self._contents.messages.append(Raw(topic, log_time, message_of(data)))
        if self._bad_chunks:
            self._contents.warnings.append(
                f'{self._path.name} is damaged: {self._bad_chunks} chunk(s) of it were left out')
        if not complete:
            self._contents.warnings.append(
                f'{self._path.name} is cut off or damaged: read {len(self._messages)} messages '
                'up to there')

    def _take_all(self, stream: BinaryIO) -> bool:
        """Take all records; return whether the end of the data was among them."""
        complete = False
        with suppress(DamagedError):
            for opcode, body, whole in _frames(stream):
                complete |= opcode in (Opcode.DATA_END, Opcode.FOOTER)
                if opcode == Opcode.FOOTER:
                    break
                if opcode == Opcode.CHUNK:
                    self._take_chunk(body, whole)
                elif whole:
                    self._take(opcode, body)
        return complete

    def _take_chunk(self, body: bytes, whole: bool) -> None:
        """Take the records of a chunk, or of its beginning where the file is cut in it."""
        try:
            chunk = _parsed(_record, Chunk, body)
            data = _parsed(_unpacked, chunk)
            crc = chunk.uncompressed_crc
            if whole and (len(data) != chunk.uncompressed_size or crc and crc != zlib.crc32(data)):
                self._bad_chunks += 1
                return
            for opcode, record, complete in _frames(io.BytesIO(data)):
                if complete:
                    self._take(opcode, record)
        except DamagedError:
            self._bad_chunks += 1

    def _take(self, opcode: int, body: bytes) -> None:
        if opcode == Opcode.MESSAGE:
            channel, _, log_time, _ = _parsed(struct.unpack_from, '<HIQQ', body)
            self._messages.append((channel, log_time, body[22:]))
        elif opcode == Opcode.SCHEMA:
            schema = _parsed(_record, Schema, body)
            self._schemas[schema.id] = schema.name
        elif opcode == Opcode.CHANNEL:
            channel = _parsed(_record, Channel, body)
            self._channels[channel.id] = topic = full_name(channel.topic)
            kind = self._schemas.get(channel.schema_id, 'of unknown type')
            self._contents.topics[topic] = type_of(kind, channel.message_encoding)


def _frames(stream: BinaryIO) -> Iterator[tuple[int, bytes, bool]]:
    """Yield the opcode and body of each record, and whether it is whole; opcode 0 is damage."""
    while len(head := stream.read(9)) == 9:
        opcode, length = struct.unpack('<BQ', head)
        if opcode == 0:
            return
        body = stream.read(min(length, PIECE))
        while len(body) < length and (piece := stream.read(min(length - len(body), PIECE))):
            body += piece
        yield opcode, body, len(body) == length


def _parsed(parse: Callable[..., Any], *args: Any) -> Any:
    """Return what a parser returns; raises DamagedError whatever the parser raises."""
    try:
        return parse(*args)
    except Exception as error:  # damaged bytes lead parsers to errors of all kinds
        raise DamagedError from error


def _record(kind: Any, body: bytes) -> Any:
    return kind.read(ReadDataStream(io.BytesIO(body)))


def _unpacked(chunk: Chunk) -> bytes:
    """Return the records of a chunk, also of the beginning of one."""
    if chunk.compression == 'zstd':
        return zstandard.ZstdDecompressor().decompressobj().decompress(chunk.data)
    if chunk.compression == 'lz4':
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data))
    if chunk.compression:
        raise McapError(f'unknown compression {chunk.compression}')
    return chunk.data
