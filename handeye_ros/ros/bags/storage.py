"""The raw messages in a rosbag2 folder or file, as far as they can be read."""
from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager, suppress
import io
from pathlib import Path
import re
import shutil
import sqlite3
import tempfile
from typing import Any, BinaryIO

from handeye_ros.errors import BagError
from handeye_ros.ros.bags.contents import Contents, full_name, message_of, Raw, type_of, ZSTD
from handeye_ros.ros.bags.mcap_file import McapFile, PIECE
import yaml
import zstandard

__all__ = ['Contents', 'Raw', 'scan']

MCAP = b'\x89MCAP0\r\n'
SQLITE = b'SQLite format 3\0'
ROS1 = b'#ROSBAG V'

SUFFIXES = ('.mcap', '.db3', '.mcap.zstd', '.db3.zstd')


def scan(path: Path, topics: Collection[str] | None = None) -> Contents:
    """
    Return what a rosbag2 folder or an .mcap or .db3 file holds (of these topics only).

    Raises BagError when there is nothing to read.

    """
    contents = Contents()
    wanted = None if topics is None else {full_name(topic) for topic in topics}
    try:
        contents.files += _files(path, contents)
        for file in contents.files:
            _scan_file(file, contents, wanted)
    except OSError as error:
        raise BagError(error.filename or path, f'cannot be read: {error.strerror or error}'
                       ) from error
    if not contents.topics:
        why = '; '.join(contents.warnings) or 'the recording was stopped before it began'
        raise BagError(path, f'holds no messages ({why}): record again')
    return contents


def _files(path: Path, contents: Contents) -> list[Path]:
    """Return the storage files of a bag in the order of recording."""
    if not path.exists():
        raise BagError(path, 'no such file or folder; expected a rosbag2 folder, or an .mcap or '
                             '.db3 file')
    if not path.is_dir():
        return [path]
    there = sorted((p for p in path.iterdir() if p.name.endswith(SUFFIXES)), key=_natural)
    # whoever played a packed bag has left the unpacked file beside it
    there = [p for p in there if p.suffix != '.zstd' or p.with_suffix('') not in there]
    if not there:
        raise BagError(path, 'is not a bag: the folder holds no .mcap or .db3 file')
    try:
        content = yaml.safe_load((path / 'metadata.yaml').read_text(encoding='utf-8'))
        names = [Path(p).name for p in content['rosbag2_bagfile_information'][
            'relative_file_paths']]
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError):
        contents.warnings.append(f'metadata.yaml is missing or damaged; read {len(there)} '
                                 'storage file(s) of the folder')
        return there
    listed = [path / name for name in names if (path / name).is_file()]
    if len(listed) < len(names):
        contents.warnings.append(f'{len(names) - len(listed)} of the {len(names)} files that '
                                 'metadata.yaml lists are missing')
    return listed or there


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts bag_10 behind bag_9."""
    return [(int(part or 0), text) for text, part in re.findall(r'(\D*)(\d*)', path.name)]


def _scan_file(path: Path, contents: Contents, wanted: set[str] | None) -> None:
    with path.open('rb') as raw:
        stream: BinaryIO = raw
        packed = raw.read(len(ZSTD)) == ZSTD
        raw.seek(0)
        if packed:
            reader: Any = zstandard.ZstdDecompressor().stream_reader(raw)
            stream = io.BufferedReader(reader)
        magic = _magic(stream)
        if magic == MCAP:
            McapFile(path, contents, wanted).scan(stream)
        elif magic == SQLITE[:len(MCAP)] and packed:
            with tempfile.NamedTemporaryFile(suffix='.db3') as unpacked:
                unpacked.write(magic + _read_all(stream))
                unpacked.flush()
                _scan_sqlite(Path(unpacked.name), path, contents, wanted)
        elif magic == SQLITE[:len(MCAP)]:
            with _with_its_log(path) as database:
                _scan_sqlite(database, path, contents, wanted)
        else:
            raise BagError(path, _not_a_bag(magic))


@contextmanager
def _with_its_log(path: Path) -> Iterator[Path]:
    """
    Give a database that holds what a recorder that was killed left in its write-ahead log.

    SQLite would put it into the file itself, but a recording is not ours to change.
    """
    log = path.with_name(f'{path.name}-wal')
    if not (log.exists() and log.stat().st_size):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        for file in (path, log):
            shutil.copyfile(file, Path(folder) / file.name)
        copy = Path(folder) / path.name
        with suppress(sqlite3.DatabaseError), closing(sqlite3.connect(copy)) as connection:
            connection.execute('PRAGMA wal_checkpoint(TRUNCATE)')
        yield copy


def _magic(stream: BinaryIO) -> bytes:
    try:
        return stream.read(len(MCAP))
    except zstandard.ZstdError:
        return ZSTD


def _not_a_bag(magic: bytes) -> str:
    if not magic:
        return 'the file is empty: record again'
    if magic == ROS1[:len(magic)]:
        return 'is a ROS 1 bag: convert it with rosbags-convert'
    return 'is not a bag; expected a rosbag2 folder, or an .mcap or .db3 file'


def _read_all(stream: BinaryIO) -> bytes:
    """Return what is left of a stream, up to where it is damaged."""
    pieces = []
    try:
        while piece := stream.read(PIECE):
            pieces.append(piece)
    except zstandard.ZstdError:
        pass
    return b''.join(pieces)


def _scan_sqlite(database: Path, path: Path, contents: Contents, wanted: set[str] | None) -> None:
    """
    Take the messages of a database.

    In the order of recording: by time, a bag of two runs would look like one. SQLite refuses
    a file that is cut off, and rightly: what lies behind the cut would be read as zeros.
    """
    connection = sqlite3.connect(f'{database.absolute().as_uri()}?immutable=1', uri=True)
    count = 0
    try:
        rows = connection.execute('SELECT id, name, type, serialization_format FROM topics')
        names = {}
        for key, name, kind, encoding in rows:
            names[key] = full_name(name)
            contents.topics[names[key]] = type_of(kind, encoding)
        for key, time, data in connection.execute(
                'SELECT topic_id, timestamp, data FROM messages ORDER BY id'):
            count += 1
            if key in names and (wanted is None or names[key] in wanted):
                contents.messages.append(Raw(names[key], time, message_of(bytes(data))))
    except (sqlite3.DatabaseError, zstandard.ZstdError) as error:
        contents.warnings.append(f'{path.name} is cut off or damaged ({error}): read {count} '
                                 'messages up to there')
    finally:
        connection.close()
