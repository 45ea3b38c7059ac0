"""
The records of an .mcap file, and what is in its chunks.

No length that a file claims is believed: nothing larger than LARGEST is ever held. Source: the
MCAP format specification (mcap.dev/spec).
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
import io
import struct
from typing import Any, BinaryIO, TypeAlias

from handeye_ros.ros.bags.contents import LARGEST, unpacked
import lz4.frame  # type: ignore[import-untyped]
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode

FOOTER = struct.Struct('<QQI')  # what it holds: start of the summary, of its offsets, crc
RECORD = struct.Struct('<BQ')
MESSAGE = struct.Struct('<HIQQ')
IN_CHUNK = struct.Struct('<BQHIQQ')  # the record of a message up to its data
CHUNK = struct.Struct('<QQQII')  # first and last time, size, crc, length of the compression
SIZE = struct.Struct('<Q')
MAGIC = 8  # bytes at either end

Bytes: TypeAlias = bytes | memoryview


class DamagedError(Exception):
    """A record is not what it says it is."""


def frames(stream: BinaryIO) -> Iterator[tuple[int, bytes, bool, int]]:
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


def record(kind: Any, body: bytes) -> Any:
    return _parsed(kind.read, ReadDataStream(io.BytesIO(body)))


def _parsed(parse: Callable[..., Any], *args: Any) -> Any:
    """Return what a parser returns; raises DamagedError whatever the parser raises."""
    try:
        return parse(*args)
    except Exception as error:  # damaged bytes lead parsers to errors of all kinds
        raise DamagedError from error


def chunk(body: bytes) -> tuple[Bytes, int, int]:
    """Return the records of a chunk, or of its beginning, their size and crc; DamagedError."""
    try:
        *_, size, crc, length = CHUNK.unpack_from(body)
        packing = body[CHUNK.size:CHUNK.size + length]
        begin = CHUNK.size + length + SIZE.size
        claimed, = SIZE.unpack_from(body, begin - SIZE.size)
    except struct.error as error:
        raise DamagedError from error
    data = memoryview(body)[begin:begin + claimed]
    if not packing:
        return data, size, crc
    unpack = {b'zstd': unpacked, b'lz4': _unpacked_lz4}.get(packing)
    if unpack is None:
        raise DamagedError
    return _parsed(unpack, data), size, crc


def _unpacked_lz4(data: Bytes) -> bytes:
    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=LARGEST))
