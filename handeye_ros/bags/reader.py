# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Messages of a rosbag2 recording (mcap or db3) in the order of the file, as far as it is readable.

A recording that is cut off (power failure, full disk) is read up to its last whole chunk.
"""
from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import closing, suppress
from functools import lru_cache, partial
from pathlib import Path
import re
import shutil
import sqlite3
import tempfile
from typing import BinaryIO, NamedTuple
import weakref

from handeye_ros.errors import InputError
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Schema
from mcap.stream_reader import breakup_chunk, StreamReader
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
        self._records_at = lru_cache(CACHED_CHUNKS)(_records_at)

    def messages(self) -> Iterator[Raw]:
        """Yield the messages; raises InputError if there is nothing to read."""
        try:
            self.files = _files(self.path)
            sizes = [file.stat().st_size for file in self.files]
            self._total = max(1.0, sum(sizes))
            for file, size in zip(self.files, sizes, strict=True):
                yield from self._messages_of(file)
                self._done += size
        except OSError as error:
            raise InputError(f'{error.filename or self.path}: cannot be read: '
                             f'{error.strerror or error}') from error
        if not self.types:
            reason = '; '.join(self.warnings) or 'the recording was stopped before it began'
            raise InputError(f'{self.path}: holds no messages ({reason}): record again')

    def _messages_of(self, path: Path) -> Iterator[Raw]:
        """Yield the messages of a file, decompressed; raises InputError if it is of no bag."""
        magic, file = _magic(path), path
        if magic.startswith(ZSTD_MAGIC):
            # messages may be read again from it, by functions that hold this reader
            folder = tempfile.mkdtemp(prefix='handeye-')
            weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
            file = Path(folder) / path.with_suffix('').name
            with path.open('rb') as packed, file.open('wb') as target, suppress(
                    zstandard.ZstdError):
                zstandard.ZstdDecompressor().copy_stream(packed, target)  # up to a damage
            magic = _magic(file) or ZSTD_MAGIC
        if magic == MCAP_MAGIC:
            return self._from_mcap(file, path.name)
        if SQLITE_MAGIC.startswith(magic) and magic:
            return self._from_database(file, path.name)
        reason = ('the file is empty: record again' if not magic else
                  'is a ROS 1 bag: convert it with rosbags-convert'
                  if ROS1_MAGIC.startswith(magic) else
                  'is not a bag; expected a rosbag2 folder, or an .mcap or .db3 file')
        raise InputError(f'{path}: {reason}')

    def _from_mcap(self, path: Path, name: str) -> Iterator[Raw]:
        """Yield the messages of an .mcap file; name: for the warnings."""
        schemas: dict[int, str] = {}
        channels: dict[int, str] = {}  # '': not requested
        count, damaged = 0, 0

        def define(record: Schema | Channel) -> None:
            if isinstance(record, Schema):
                schemas[record.id] = record.name
            else:
                channels[record.id] = self._registered(
                    record.topic, schemas.get(record.schema_id, 'of unknown type'),
                    record.message_encoding)

        with path.open('rb') as stream:
            with suppress(Exception):  # its end repeats what a damaged chunk may define
                summary = make_reader(stream).get_summary()
                for definition in (*summary.schemas.values(), *summary.channels.values()):
                    define(definition)
            start, complete = 0, False
            for record in _up_to_damage(stream, start):
                if complete := isinstance(record, DataEnd):
                    break
                self._advanced(start)
                try:
                    records = _expanded(record)
                except Exception:  # noqa: BLE001 - of decompressors, and of the parser
                    damaged += 1
                    records = []
                for index, one in enumerate(records):
                    if isinstance(one, Schema | Channel):
                        define(one)
                    elif isinstance(one, Message):
                        count += 1
                        if topic := channels.get(one.channel_id):
                            yield Raw(topic, one.log_time, _message(one.data),
                                      partial(self._from_chunk, path, start, index))
                start = stream.tell()
        if damaged or not complete:
            left_out = f', left out {damaged} damaged chunk(s)' if damaged else ''
            self.warnings.append(f'{name} is cut off or damaged: read {count} messages{left_out}')

    def _from_chunk(self, path: Path, start: int, index: int) -> bytes:
        """Return a message of an .mcap file again: one record in that at a position."""
        try:
            return _message(self._records_at(path, start)[index].data)
        except Exception:  # noqa: BLE001 - the file has changed
            return b''

    def _from_database(self, path: Path, name: str) -> Iterator[Raw]:
        """
        Yield the messages of a .db3 file; name: for the warnings.

        In the order of recording: by time, a bag of two runs would look like one. SQLite refuses a
        truncated file.
        """
        log = path.with_name(f'{path.name}-wal')
        if log.exists() and log.stat().st_size:
            self.warnings.append(f'the recorder of {name} was killed, and {log.name} holds '
                                 'messages that are not read: "ros2 bag info" merges them into '
                                 'the file')
        count = position = 0
        try:
            with closing(_connected(path)) as database:
                names = {}
                for key, topic, kind, encoding in database.execute(
                        'SELECT id, name, type, serialization_format FROM topics'):
                    if wanted := self._registered(str(topic), str(kind), str(encoding)):
                        names[key] = wanted
                marks = ', '.join('?' * len(names))
                for key, number, time, data in database.execute(
                        'SELECT id, topic_id, timestamp, data FROM messages '
                        f'WHERE topic_id IN ({marks}) ORDER BY id', list(names)):
                    yield Raw(names[number], int(time), _message(bytes(data)),
                              partial(self._from_row, path, key))
                    count, position = count + 1, position + len(data)
                    if count % 1000 == 0:
                        self._advanced(position)
        except (sqlite3.Error, TypeError, ValueError, OverflowError) as error:
            self.warnings.append(f'{name} is cut off or damaged ({error}): read {count} messages '
                                 'up to there')

    def _from_row(self, path: Path, key: int) -> bytes:
        """Return a message of a .db3 file again."""
        try:
            with closing(_connected(path)) as database:
                (data,), = database.execute('SELECT data FROM messages WHERE id = ?', (key,))
            return _message(bytes(data))
        except (sqlite3.Error, TypeError, ValueError):
            return b''  # the file has changed

    def _registered(self, topic: str, kind: str, encoding: str) -> str:
        """Take note of a topic and its type; return its name, '' if it is not requested."""
        topic = full_name(topic)
        package, _, name = kind.partition('/')  # some write it as ROS 1 did
        kind = kind if not name or '/' in name else f'{package}/msg/{name}'
        self.types[topic] = kind if encoding == 'cdr' else f'{kind} in {encoding}'
        return topic if self._topics is None or topic in self._topics else ''

    def _advanced(self, position: int) -> None:
        """Tell how many bytes of the file were read; of a compressed file that is a guess."""
        self._progress(min(1.0, (self._done + position) / self._total))


def full_name(topic: str) -> str:
    """Return a topic with its leading slash."""
    return '/' + topic.lstrip('/')


def _files(path: Path) -> list[Path]:
    """Return the storage files of a bag in recording order, which their numbers tell."""
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
    return stored


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a sort key with bag_10 after bag_9."""
    return [(int(digits or 0), text) for text, digits in re.findall(r'(\D*)(\d*)', path.name)]


def _magic(path: Path) -> bytes:
    with path.open('rb') as stream:
        return stream.read(len(MCAP_MAGIC))


def _message(data: bytes) -> bytes:
    """Return a message, decompressed if the recorder compressed each one; CDR starts with 0."""
    if data[:4] != ZSTD_MAGIC:
        return data
    try:
        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            return stream.read(LARGEST_RECORD)
    except zstandard.ZstdError:
        return b''  # no message of any type


def _up_to_damage(stream: BinaryIO, start: int) -> Iterator[McapRecord]:
    """Yield the records of an .mcap file from a position on; damaged bytes end them."""
    stream.seek(start)
    with suppress(Exception):  # of all kinds, in the parser
        yield from StreamReader(stream, skip_magic=start > 0, emit_chunks=True,
                                record_size_limit=LARGEST_RECORD).records


def _expanded(record: McapRecord) -> list[McapRecord]:
    """Return a record, or those in a chunk; raises any kind of error for a damaged one."""
    if not isinstance(record, Chunk):
        return [record]
    if record.uncompressed_size > LARGEST_RECORD:
        raise ValueError(f'a chunk of {record.uncompressed_size} bytes')
    return breakup_chunk(record, validate_crc=True)


def _records_at(path: Path, start: int) -> list[McapRecord]:
    with path.open('rb') as stream:
        return _expanded(next(_up_to_damage(stream, start)))


def _connected(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(f'{path.absolute().as_uri()}?immutable=1', uri=True)
