"""
Messages as they are serialised (CDR), read as far as is needed and without a copy.

Only the two messages that come by the thousands are read here, PointCloud2 and PoseStamped; the
parts have the names of the messages, so that messages.py takes them like those of rclpy.
Whatever the bytes are, they give a message or MessageError. Source: the OMG's CDR encodings
(DDS-XTypes 1.3, 7.4.1, plain CDR as rmw_fastrtps writes it).
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
import struct
from typing import NamedTuple

from handeye_ros.ros.errors import MessageError

STAMPED = 12  # where the stamp ends
FRAME = 16  # where the characters of the frame_id lie
FRAMES = 100  # that are remembered: they come thousands of times
ENCAPSULATION = 4  # bytes before the message: its encoding, big or little endian
MOST_FIELDS = 1000  # of a point; a count that damage made absurd must not become a loop


class Header(NamedTuple):
    """A std_msgs/Header; stamp: ns."""

    stamp: int
    frame_id: str


@dataclass(frozen=True, slots=True)
class Field:
    """A sensor_msgs/PointField."""

    name: str
    offset: int
    datatype: int
    count: int


class Cloud(NamedTuple):
    """A sensor_msgs/PointCloud2; data_start: where its data lies in the bytes of the message."""

    header: Header
    height: int
    width: int
    fields: tuple[Field, ...]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: memoryview
    data_start: int


_HEADERS = {order: struct.Struct(f'{order}iII') for order in '<>'}
_STAMPS = {order: struct.Struct(f'{order}iI') for order in '<>'}
_POSES = {order: struct.Struct(f'{order}7d') for order in '<>'}
_TRIPLES = {order: struct.Struct(f'{order}III') for order in '<>'}
_NUMBERS = {order: struct.Struct(f'{order}I') for order in '<>'}


def byte_order(data: bytes, kind: str) -> str:
    """Return the byte order of a message for struct; raises MessageError."""
    if data[:2] == b'\x00\x01':
        return '<'
    if data[:2] == b'\x00\x00':
        return '>'
    raise MessageError(kind, 'it is empty, or not serialised as ROS does (CDR)')


def stamp_of(data: bytes) -> int:
    """Return the stamp (ns) of a message known to begin with a header."""
    sec, nanosec = _STAMPS['<' if data[1] else '>'].unpack_from(data, ENCAPSULATION)
    return int(sec * 1_000_000_000 + nanosec)


def header(data: bytes, kind: str) -> tuple[Header, int]:
    """Return the header that a message starts with, and where it ends; raises MessageError."""
    order = byte_order(data, kind)
    try:
        sec, nanosec, length = _HEADERS[order].unpack_from(data, ENCAPSULATION)
    except struct.error as error:
        raise MessageError(kind, f'damaged message: {error}') from error
    end = FRAME + length
    if end > len(data):
        raise MessageError(kind, 'damaged message: its frame_id does not end')
    return Header(sec * 1_000_000_000 + nanosec, _frame(data[FRAME:end], kind)), end


@lru_cache(FRAMES)
def _frame(data: bytes, kind: str) -> str:
    return _text(data, 0, len(data), kind)


def _text(data: bytes, start: int, end: int, kind: str) -> str:
    """Return a string, without the zero that ends it."""
    try:
        return data[start:max(start, end - 1)].decode()
    except UnicodeDecodeError as error:
        raise MessageError(kind, f'damaged message: {error}') from error


def pose(data: bytes) -> tuple[Header, tuple[float, ...]]:
    """Return header and x y z, qx qy qz qw of a geometry_msgs/PoseStamped; MessageError."""
    head, end = header(data, 'PoseStamped')
    try:
        return head, _POSES[byte_order(data, 'PoseStamped')].unpack_from(data, aligned(end, 8))
    except struct.error as error:
        raise MessageError('PoseStamped', f'damaged message: {error}') from error


def cloud(data: bytes) -> Cloud:
    """Return a sensor_msgs/PointCloud2, its data a view of the bytes; raises MessageError."""
    try:
        return _cloud(data)
    except struct.error as error:
        raise MessageError('PointCloud2', f'damaged message: {error}') from error


def _cloud(data: bytes) -> Cloud:
    head, end = header(data, 'PointCloud2')
    order = byte_order(data, 'PointCloud2')
    position = aligned(end, 4)
    height, width, count = _TRIPLES[order].unpack_from(data, position)
    if count > MOST_FIELDS:
        raise MessageError('PointCloud2', f'damaged message: its points have {count} fields')
    position += 12
    fields = []
    for _ in range(count):
        field, position = _field(data, position, order)
        fields.append(field)
    bigendian = data[position:position + 1] not in (b'', b'\0')
    position = aligned(position + 1, 4)
    point_step, row_step, length = _TRIPLES[order].unpack_from(data, position)
    start = position + 12
    if start + length > len(data):
        raise MessageError('PointCloud2', f'damaged message: {len(data) - start} of {length} '
                           'bytes of its data are there')
    return Cloud(head, height, width, tuple(fields), bigendian, point_step, row_step,
                 memoryview(data)[start:start + length], start)


def row(data: bytes, index: int, stamp: int) -> bytes:
    """Return the message of one row of a serialised cloud, with a stamp; raises MessageError."""
    whole = cloud(data)
    order = byte_order(data, 'PointCloud2')
    size = whole.width * whole.point_step
    begin = index * (whole.row_step or size)
    if index >= whole.height or begin + size > len(whole.data):
        raise MessageError('PointCloud2', f'damaged message: it has no row {index}')
    _, end = header(data, 'PointCloud2')
    height = aligned(end, 4)
    return b''.join((
        data[:ENCAPSULATION], struct.pack(f'{order}iI', *divmod(stamp, 1_000_000_000)),
        data[ENCAPSULATION + 8:height], _NUMBERS[order].pack(1),
        data[height + 4:whole.data_start - 8], _NUMBERS[order].pack(size),
        _NUMBERS[order].pack(size), whole.data[begin:begin + size], b'\0'))


def _field(data: bytes, position: int, order: str) -> tuple[Field, int]:
    """Return the field of a point that starts at a position, and where the next one starts."""
    position = aligned(position, 4)
    (length,) = _NUMBERS[order].unpack_from(data, position)
    start, end = position + 4, position + 4 + length
    if end > len(data):
        raise MessageError('PointCloud2', 'damaged message: the name of a field does not end')
    offset, = _NUMBERS[order].unpack_from(data, aligned(end, 4))
    place = aligned(end, 4) + 4
    datatype, = struct.unpack_from('B', data, place)
    count, = _NUMBERS[order].unpack_from(data, aligned(place + 1, 4))
    name = _text(data, start, end, 'PointCloud2')
    return Field(name, offset, datatype, count), aligned(place + 1, 4) + 4


def aligned(position: int, size: int) -> int:
    """Return where a value of this size lies; CDR counts from behind the encapsulation."""
    return position + (ENCAPSULATION - position) % size
