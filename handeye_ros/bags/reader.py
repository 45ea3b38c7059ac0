# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Messages of a rosbag2 recording (mcap or db3) in the order of the file, as far as it is readable.

A recording that is cut off (power failure, full disk) is read up to its end, also within a chunk.
Nothing larger than LARGEST_RECORD is held in memory, whatever lengths a damaged file states.
"""
from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import closing, suppress
from functools import lru_cache, partial
import io
from pathlib import Path
import re
import shutil
import sqlite3
import struct
import tempfile
from typing import BinaryIO, NamedTuple
import weakref
import zlib

from handeye_ros.config import yaml_content
from handeye_ros.errors import InputError
import lz4.frame  # type: ignore[import-untyped]
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Schema
import yaml
import zstandard

CLOUD_TYPE = 'sensor_msgs/msg/PointCloud2'
POSE_TYPE = 'geometry_msgs/msg/PoseStamped'
JOINTS_TYPE = 'sensor_msgs/msg/JointState'
TF_TYPE = 'tf2_msgs/msg/TFMessage'
STRING_TYPE = 'std_msgs/msg/String'

MCAP_MAGIC = b'\x89MCAP0\r\n'
SQLITE_MAGIC = b'SQLite format 3\0'
ROS1_MAGIC = b'#ROSBAG V'
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
SUFFIXES = ('.mcap', '.db3', '.mcap.zstd', '.db3.zstd')

RECORD_HEAD = struct.Struct('<BQ')  # opcode and length of an mcap record
MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, number, time of receipt and of publishing
DEFINITIONS: dict[int, type[Schema | Channel]] = {Opcode.SCHEMA: Schema,
                                                  Opcode.CHANNEL: Channel}
LARGEST_RECORD = 1 << 28  # bytes of a record or message, compressed or not: none is larger
CACHED_CHUNKS = 4  # decompressed chunks in memory: the profiles of a stop are close together


class Raw(NamedTuple):
    """
    A message as it was recorded.

    log_time: ns; fetch: reads data again, so that they need not be kept; they are empty if the
    file has changed.
    """

    topic: str
    log_time: int
    data: bytes
    fetch: Callable[[], bytes] = bytes


class Reader:
    """
    Reads the messages of a rosbag2 folder or an .mcap or .db3 file, all or those of some topics.

    types: of all topics by name
    warnings: on unreadable data
    files: those that were read. All three are complete after the last message.
    """

    def __init__(self, path: Path, topics: Collection[str] | None = None,
                 progress: Callable[[float], None] = lambda share: None) -> None:
        """progress: receives the fraction of the bytes that were read."""
        self.path = path
        self.types: dict[str, str] = {}
        self.warnings: list[str] = []
        self.files: list[Path] = []
        self._topics = None if topics is None else {full_name(topic) for topic in topics}
        self._progress = progress
        self._done = 0.0  # bytes of the files that were read, and of all
        self._total = 1.0

    def messages(self) -> Iterator[Raw]:
        """Yield the messages; raises InputError if there is nothing to read."""
        try:
            self.files = _files(self.path, self.warnings)
            sizes = [file.stat().st_size for file in self.files]
            self._total = max(1.0, sum(sizes))
            for file, size in zip(self.files, sizes, strict=True):
                yield from _storage(file, self).messages()
                self._done += size
        except OSError as error:
            raise InputError(f'{error.filename or self.path}: cannot be read: '
                             f'{error.strerror or error}') from error
        if not self.types:
            reason = '; '.join(self.warnings) or 'the recording was stopped before it began'
            raise InputError(f'{self.path}: holds no messages ({reason}): record again')

    def register_topic(self, topic: str, kind: str, encoding: str) -> str:
        """Take note of a topic and its type; return its name, '' if it is not requested."""
        topic = full_name(topic)
        package, _, name = kind.partition('/')  # some write it as ROS 1 did
        kind = kind if not name or '/' in name else f'{package}/msg/{name}'
        self.types[topic] = kind if encoding == 'cdr' else f'{kind} in {encoding}'
        return topic if self._topics is None or topic in self._topics else ''

    def advanced(self, position: int) -> None:
        """Tell how many bytes of the file were read; of a compressed file that is a guess."""
        self._progress(min(1.0, (self._done + position) / self._total))


def full_name(topic: str) -> str:
    """Return a topic with its leading slash."""
    return '/' + topic.lstrip('/')


def _files(path: Path, warnings: list[str]) -> list[Path]:
    """Return the storage files of a bag in recording order."""
    if not path.exists():
        raise InputError(f'{path}: no such file or folder; expected a rosbag2 folder, or an .mcap '
                         'or .db3 file')
    if not path.is_dir():
        return [path]
    stored = sorted((p for p in path.iterdir() if p.name.endswith(SUFFIXES)), key=_natural)
    # playing a compressed bag leaves the decompressed file beside it
    stored = [p for p in stored if p.suffix != '.zstd' or p.with_suffix('') not in stored]
    if not stored:
        raise InputError(f'{path}: is not a bag: the folder holds no .mcap or .db3 file')
    try:
        content = yaml_content((path / 'metadata.yaml').read_text(encoding='utf-8'))
        names = [Path(p).name for p in content['rosbag2_bagfile_information'][
            'relative_file_paths']]
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError, RecursionError):
        warnings.append(f'metadata.yaml is missing or damaged; read {len(stored)} storage file(s) '
                        'of the folder')
        return stored
    listed = [path / name for name in names if (path / name).is_file()]
    if len(listed) < len(names):
        warnings.append(f'{len(names) - len(listed)} of the {len(names)} files that '
                        'metadata.yaml lists are missing')
    return listed or stored


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a sort key with bag_10 after bag_9."""
    return [(int(digits or 0), text) for text, digits in re.findall(r'(\D*)(\d*)', path.name)]


def _storage(path: Path, reader: Reader) -> _Mcap | _Sqlite:
    """Return a storage file, decompressed; raises InputError for other files."""
    magic, file, folder = _magic(path), path, None
    if magic[:len(ZSTD_MAGIC)] == ZSTD_MAGIC:
        folder = tempfile.mkdtemp(prefix='handeye-')
        file = Path(folder) / path.with_suffix('').name
        with path.open('rb') as packed, file.open('wb') as target, suppress(zstandard.ZstdError):
            zstandard.ZstdDecompressor().copy_stream(packed, target)  # up to a damage
        magic = _magic(file) or ZSTD_MAGIC
    storage: _Mcap | _Sqlite
    if magic == MCAP_MAGIC:
        storage = _Mcap(file, path.name, reader)
    elif magic == SQLITE_MAGIC[:len(MCAP_MAGIC)]:
        storage = _Sqlite(file, path.name, reader)
    else:
        reason = ('the file is empty: record again' if not magic else
                  'is a ROS 1 bag: convert it with rosbags-convert'
                  if magic == ROS1_MAGIC[:len(magic)] else
                  'is not a bag; expected a rosbag2 folder, or an .mcap or .db3 file')
        raise InputError(f'{path}: {reason}')
    if folder:  # messages may be read again from it as long as the storage exists
        weakref.finalize(storage, shutil.rmtree, folder, ignore_errors=True)
    return storage


def _magic(path: Path) -> bytes:
    with path.open('rb') as stream:
        return stream.read(len(MCAP_MAGIC))


def _message(data: bytes) -> bytes:
    """Return a message, decompressed if the recorder compressed each one; CDR starts with 0."""
    if data[:4] != ZSTD_MAGIC:
        return data
    try:
        return _unpacked(data)
    except zstandard.ZstdError:
        return b''  # no message of any type


def _unpacked(data: bytes) -> bytes:
    """Return decompressed zstd data, also if cut off."""
    with zstandard.ZstdDecompressor().stream_reader(data) as stream:
        return stream.read(LARGEST_RECORD)


class _Mcap:
    """
    An .mcap file; its channels may be defined within chunks, and again at its end.

    Read by hand: mcap's readers take several times as long, or nothing from a cut or damaged file.
    """

    def __init__(self, path: Path, name: str, reader: Reader) -> None:
        """name: for the warnings."""
        self._path, self._name, self._reader = path, name, reader
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, str] = {}  # '': not requested
        # a reference to this file, and to its temporary folder, is kept by each message
        self._records_at = lru_cache(CACHED_CHUNKS)(self._read_again)

    def messages(self) -> Iterator[Raw]:
        """Yield the messages of the topics that the reader wants."""
        count, damaged, complete = 0, 0, False
        with self._path.open('rb') as stream:
            with suppress(Exception):  # damaged bytes cause all kinds of errors in the parser
                summary = SeekingReader(stream, record_size_limit=LARGEST_RECORD).get_summary()
                if summary:
                    for definition in (*summary.schemas.values(), *summary.channels.values()):
                        self._define(definition)
            stream.seek(len(MCAP_MAGIC))
            for start, opcode, content, whole in _records(stream):
                self._reader.advanced(start)
                if opcode == Opcode.DATA_END:
                    complete = True
                    break
                try:
                    records = _expanded(opcode, content, whole)
                except Exception:  # noqa: BLE001 - of decompressors, and of the parser
                    damaged += 1
                    continue
                for index, (kind, record) in enumerate(records):
                    if kind == Opcode.MESSAGE and len(record) >= MESSAGE_HEAD.size:
                        count += 1
                        channel, _, log_time, _ = MESSAGE_HEAD.unpack_from(record)
                        if topic := self._channels.get(channel):
                            yield Raw(topic, log_time, _message(bytes(record[MESSAGE_HEAD.size:])),
                                      partial(self._fetch, start, index))
                    elif kind in DEFINITIONS:
                        with suppress(Exception):  # damaged: its messages are unknown
                            self._define(DEFINITIONS[kind].read(ReadDataStream(
                                io.BytesIO(record))))
        if damaged:
            self._reader.warnings.append(
                f'{self._name} is damaged: {damaged} chunk(s) of it were left out')
        if not complete:
            self._reader.warnings.append(f'{self._name} is cut off or damaged: read {count} '
                                         'messages up to there')

    def _define(self, record: Schema | Channel) -> None:
        """Take note of a schema or a channel."""
        if isinstance(record, Schema):
            self._schemas[record.id] = record.name
            return
        kind = self._schemas.get(record.schema_id, 'of unknown type')
        self._channels[record.id] = self._reader.register_topic(record.topic, kind,
                                                                record.message_encoding)

    def _fetch(self, start: int, index: int) -> bytes:
        try:
            return _message(bytes(self._records_at(start)[index][1][MESSAGE_HEAD.size:]))
        except Exception:  # noqa: BLE001 - the file has changed
            return b''

    def _read_again(self, start: int) -> list[tuple[int, memoryview]]:
        with self._path.open('rb') as stream:
            stream.seek(start)
            _, opcode, content, whole = next(_records(stream))
        return _expanded(opcode, content, whole)


def _records(stream: BinaryIO) -> Iterator[tuple[int, int, bytes, bool]]:
    """Yield position, opcode, content of each mcap record, and whether it is not cut off."""
    while True:
        start = stream.tell()
        head = stream.read(RECORD_HEAD.size)
        if len(head) < RECORD_HEAD.size:
            return
        opcode, length = RECORD_HEAD.unpack(head)
        content = stream.read(min(length, LARGEST_RECORD))
        yield start, opcode, content, len(content) == length


def _expanded(opcode: int, content: bytes, whole: bool) -> list[tuple[int, memoryview]]:
    """Return a record, or those in a chunk; raises any kind of error for a damaged one."""
    if opcode != Opcode.CHUNK:
        return [(opcode, memoryview(content))] if whole else []
    chunk = Chunk.read(ReadDataStream(io.BytesIO(content)))
    data: bytes = chunk.data
    if chunk.compression == 'lz4':
        data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=LARGEST_RECORD)
    elif chunk.compression == 'zstd':
        data = _unpacked(data)
    if whole and (len(data) != chunk.uncompressed_size or chunk.uncompressed_crc
                  and chunk.uncompressed_crc != zlib.crc32(data)):
        raise ValueError('the chunk is damaged')
    view, records, begin = memoryview(data), [], RECORD_HEAD.size
    while begin <= len(view):
        kind, length = RECORD_HEAD.unpack_from(view, begin - RECORD_HEAD.size)
        record = view[begin:begin + length]
        if len(record) == length:
            records.append((kind, record))
        begin += length + RECORD_HEAD.size
    return records


class _Sqlite:
    """
    A database.

    In the order of recording: by time, a bag of two runs would look like one. SQLite refuses a
    truncated file.
    """

    def __init__(self, path: Path, name: str, reader: Reader) -> None:
        """name: for the warnings."""
        self._path, self._name, self._reader = path, name, reader
        log = path.with_name(f'{path.name}-wal')
        if log.exists() and log.stat().st_size:
            reader.warnings.append(f'the recorder of {name} was killed, and {log.name} holds '
                                   'messages that are not read: "ros2 bag info" merges them into '
                                   'the file')

    def messages(self) -> Iterator[Raw]:
        """Yield the messages of the topics that the reader wants."""
        count = position = 0
        try:
            with closing(self._connected()) as database:
                names = {}
                for key, name, kind, encoding in database.execute(
                        'SELECT id, name, type, serialization_format FROM topics'):
                    if topic := self._reader.register_topic(str(name), str(kind), str(encoding)):
                        names[key] = topic
                marks = ', '.join('?' * len(names))
                for key, number, time, data in database.execute(
                        'SELECT id, topic_id, timestamp, data FROM messages '
                        f'WHERE topic_id IN ({marks}) ORDER BY id', list(names)):
                    yield Raw(names[number], int(time), _message(bytes(data)),
                              partial(self._fetch, key))
                    count, position = count + 1, position + len(data)
                    if count % 1000 == 0:
                        self._reader.advanced(position)
        except (sqlite3.Error, TypeError, ValueError, OverflowError) as error:
            self._reader.warnings.append(f'{self._name} is cut off or damaged ({error}): read '
                                         f'{count} messages up to there')

    def _connected(self) -> sqlite3.Connection:
        return sqlite3.connect(f'{self._path.absolute().as_uri()}?immutable=1', uri=True)

    def _fetch(self, key: int) -> bytes:
        try:
            with closing(self._connected()) as database:
                (data,), = database.execute('SELECT data FROM messages WHERE id = ?', (key,))
            return _message(bytes(data))
        except (sqlite3.Error, TypeError, ValueError):
            return b''  # the file has changed
