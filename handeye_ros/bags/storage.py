# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Messages of a rosbag2 recording (mcap or db3) in the order of the file, as far as it is readable.

An .mcap file that is cut off (power failure, full disk) is read up to its last whole chunk, a .db3
file as far as SQLite reads it.
"""
from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import closing, suppress
from functools import lru_cache, partial
from operator import attrgetter
from pathlib import Path
import sqlite3
from typing import Any, BinaryIO, NamedTuple

from handeye_ros.errors import InputError
from handeye_ros.words import count_of
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Schema
from mcap.stream_reader import breakup_chunk, StreamReader
import zstandard

CLOUD_TYPE = 'sensor_msgs/msg/PointCloud2'
POSE_TYPE = 'geometry_msgs/msg/PoseStamped'
JOINTS_TYPE = 'sensor_msgs/msg/JointState'
TF_TYPE = 'tf2_msgs/msg/TFMessage'
STRING_TYPE = 'std_msgs/msg/String'

# the first bytes of files
MCAP_MAGIC = b'\x89MCAP0\r\n'
SQLITE_MAGIC = b'SQLite f'
ROS1_MAGIC = b'#ROSBAG '
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
SUFFIXES = ('.mcap', '.db3')

MAX_RECORD = 1 << 28  # bytes of a record or message, compressed or not: none is larger
CACHED_CHUNKS = 4  # decompressed chunks in memory: the profiles of a stop are close together


class RecordedMessage(NamedTuple):
    """
    A message as it is recorded.

    message_type: the ROS type, such as CLOUD_TYPE
    log_time: when it was recorded (ns)
    data: the message, serialised
    fetch: reads the data again, so that they need not be kept; returns b'' if the file has changed
    """

    topic: str
    message_type: str
    log_time: int
    data: bytes
    fetch: Callable[[], bytes] = bytes


by_log_time = attrgetter('log_time')


class Reader:
    """
    Reads the messages of a rosbag2 folder or an .mcap or .db3 file, all or those of some topics.

    After the last message these are complete:

    types: of all topics, by name
    warnings: on unreadable data
    files: those that were read
    """

    def __init__(self, path: Path, topics: Collection[str] | None = None,
                 progress: Callable[[float], None] = lambda share: None) -> None:
        """
        Read nothing yet.

        topics: of the messages to be read, None: all; progress: receives the fraction of the bytes
        that were read.
        """
        self.path = path
        self.types: dict[str, str] = {}
        self.warnings: list[str] = []
        self.files: list[Path] = []
        self._topics = None if topics is None else {full_name(topic) for topic in topics}
        self._progress = progress
        self._before, self._total = 0, 1  # bytes of files: before the current one, of all

    def messages(self) -> Iterator[RecordedMessage]:
        """Yield the messages; raises InputError if there is nothing to read."""
        try:
            self.files = _files(self.path)
            self._total = sum(file.stat().st_size for file in self.files)
            for file in self.files:
                yield from self._messages_of(file)
                self._before += file.stat().st_size
        except OSError as error:
            raise InputError(f'{error.filename or self.path}: cannot be read: '
                             f'{error.strerror or error}') from error
        if not self.types:
            reason = '; '.join(self.warnings) or 'the recording was stopped before it began'
            raise InputError(f'{self.path}: holds no messages ({reason}): record again')

    def _messages_of(self, path: Path) -> Iterator[RecordedMessage]:
        """Yield the messages of a file; raises InputError if it is of no bag."""
        with path.open('rb') as stream:
            magic = stream.read(8)
        if magic == MCAP_MAGIC:
            return self._from_mcap(path)
        if magic == SQLITE_MAGIC:
            return self._from_database(path)
        if len(self.files) > 1 and magic != ROS1_MAGIC and magic[:4] != ZSTD_MAGIC:
            self._warn_of_damage(path, 'it holds nothing of a bag')
            return iter(())
        reason = ('the file is empty: record again' if not magic else
                  'is a ROS 1 bag: convert it with rosbags-convert' if magic == ROS1_MAGIC else
                  'is compressed: unpack it with zstd -d' if magic[:4] == ZSTD_MAGIC else
                  'is not a bag; expected a rosbag2 folder, or an .mcap or .db3 file')
        raise InputError(f'{path}: {reason}')

    def _from_mcap(self, path: Path) -> Iterator[RecordedMessage]:
        """Yield the messages of an .mcap file, of whole chunks, in the order of the file."""
        schemas: dict[int, str] = {}
        channels: dict[int, str] = {}  # the topic of each, '' if it is not requested
        message_count = damaged_chunks = start = 0
        complete, data_at = False, lru_cache(CACHED_CHUNKS)(partial(_chunk_data, path))
        with path.open('rb') as stream:
            for outer in _up_to_damage(stream, start):
                if complete := isinstance(outer, DataEnd):
                    break
                records = _expanded(outer)
                damaged_chunks += records is None
                for index, record in enumerate(records or ()):
                    if isinstance(record, Schema):
                        schemas[record.id] = record.name
                    elif isinstance(record, Channel):
                        channels[record.id] = self._register(
                            record.topic, schemas.get(record.schema_id, 'of unknown type'),
                            record.message_encoding)
                    elif isinstance(record, Message):
                        message_count += 1
                        if topic := channels.get(record.channel_id):
                            yield RecordedMessage(topic, self.types[topic], record.log_time,
                                                  _unpacked(record.data),
                                                  partial(_read_again, data_at, start, index))
                start = stream.tell()
                self._progress((self._before + start) / self._total)
        if damaged_chunks or not complete:
            dropped = f', dropped {damaged_chunks} damaged chunk(s)' if damaged_chunks else ''
            self._warn_of_damage(path, f'read {count_of(message_count, "message")}{dropped}')

    def _from_database(self, path: Path) -> Iterator[RecordedMessage]:
        """Yield the messages in the order of recording: by time, two runs would look like one."""
        count = 0
        try:
            with closing(_connect(path)) as database:
                names = {key: self._register(topic, message_type, encoding)
                         for key, topic, message_type, encoding in database.execute(
                             'SELECT id, name, type, serialization_format FROM topics')}
                for key, topic, time, data in database.execute(
                        'SELECT id, topic_id, timestamp, data FROM messages ORDER BY id'):
                    if name := names[topic]:
                        yield RecordedMessage(name, self.types[name], int(time), _unpacked(data),
                                              partial(_read_again, partial(_row_data, path), key))
                    count += 1
        except Exception as error:  # noqa: BLE001 - of SQLite, and of what damaged rows hold
            self._warn_of_damage(path, f'{error}; read {count_of(count, "message")} up to there')

    def _warn_of_damage(self, path: Path, what: str) -> None:
        self.warnings.append(f'{path.name} is cut off or damaged: {what}')

    def _register(self, topic: str, message_type: str, encoding: str) -> str:
        """Keep the type of a topic; return the topic's full name, '' if it is not requested."""
        topic = full_name(topic)
        self.types[topic] = message_type + (f' in {encoding}' if encoding != 'cdr' else '')
        return topic if self._topics is None or topic in self._topics else ''


def full_name(topic: str) -> str:
    """Return a topic with its leading slash."""
    return '/' + topic.lstrip('/')


def _files(path: Path) -> list[Path]:
    """Return the storage files of a bag in the order of their numbers; raises InputError."""
    if not path.exists():
        raise InputError(f'{path}: no such file or folder; expected a rosbag2 folder, or an .mcap '
                         'or .db3 file')
    if not path.is_dir():
        return [path]
    # names differ in their numbers alone: the longer one has the larger number
    stored = sorted((p for p in path.iterdir() if p.suffix in SUFFIXES),
                    key=lambda p: (len(p.name), p.name))
    if not stored:
        raise InputError(f'{path}: is not a bag: the folder holds no .mcap or .db3 file; unpack '
                         'compressed ones (.zstd) with zstd -d')
    return stored


def _unpacked(data: bytes) -> bytes:
    """
    Return a message, decompressed if the recorder compressed each one.

    No message starts like a compressed one: CDR starts with 0.
    """
    if data[:4] != ZSTD_MAGIC:
        return data
    try:
        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            return stream.read(MAX_RECORD)
    except zstandard.ZstdError:
        return b''  # no message of any type


def _up_to_damage(stream: BinaryIO, start: int) -> Iterator[McapRecord]:
    """Yield the records of an .mcap file from a position on; damaged bytes end them."""
    stream.seek(start)
    with suppress(Exception):  # of all kinds, in the parser
        yield from StreamReader(stream, skip_magic=start > 0, emit_chunks=True,
                                record_size_limit=MAX_RECORD).records


def _expanded(record: McapRecord) -> list[Any] | None:
    """Return the records in a chunk, or the record itself; None if it is damaged."""
    if not isinstance(record, Chunk):
        return [record]
    with suppress(Exception):  # of all kinds, in decompressors and in the parser
        if record.uncompressed_size <= MAX_RECORD:
            return breakup_chunk(record, validate_crc=True)
    return None


def _read_again(find: Callable[[int], list[bytes]], place: int, index: int = 0) -> bytes:
    """
    Return a message of a file again, b'' if the file has changed.

    find: returns the messages at a place in the file
    index: that of the message among these
    """
    try:
        return _unpacked(bytes(find(place)[index]))
    except Exception:  # noqa: BLE001 - of what other bytes there may cause
        return b''


def _chunk_data(path: Path, start: int) -> list[bytes]:
    """Return the data of each record in the chunk at a position of an .mcap file."""
    with path.open('rb') as stream:
        records = _expanded(next(_up_to_damage(stream, start)))
    return [getattr(record, 'data', b'') for record in records or ()]


def _row_data(path: Path, key: int) -> list[bytes]:
    """Return the message of a row of a .db3 file."""
    with closing(_connect(path)) as database:
        return [data for data, in database.execute('SELECT data FROM messages WHERE id = ?',
                                                   (key,))]


def _connect(path: Path) -> sqlite3.Connection:
    """Connect to a .db3 file; only to read a write-ahead log SQLite must write beside it."""
    mode = 'mode=ro' if path.with_name(f'{path.name}-wal').exists() else 'immutable=1'
    return sqlite3.connect(f'{path.absolute().as_uri()}?{mode}', uri=True)
