"""The raw messages in a rosbag2 folder or file, as far as they can be read."""
from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import closing, suppress
from pathlib import Path
import re
import shutil
import sqlite3
import tempfile
import weakref

from handeye_ros.config import yaml_content
from handeye_ros.errors import BagError
from handeye_ros.ros.bags.contents import (
    Block,
    Contents,
    full_name,
    Gathered,
    message_of,
    Raw,
    type_of,
    ZSTD,
)
from handeye_ros.ros.bags.mcap_file import McapFile
import yaml
import zstandard

Progress = Callable[[float], None]

MCAP = b'\x89MCAP0\r\n'
SQLITE = b'SQLite format 3\0'
ROS1 = b'#ROSBAG V'

SUFFIXES = ('.mcap', '.db3', '.mcap.zstd', '.db3.zstd')


def scan(path: Path, topics: Collection[str] | None = None) -> Contents:
    """Return what a bag holds, and its messages (of these topics only); raises as pieces."""
    contents = Contents()
    contents.messages += messages(path, contents, topics)
    return contents


def messages(path: Path, contents: Contents, topics: Collection[str] | None = None
             ) -> Iterator[Raw]:
    """Yield the messages of a bag one by one; see pieces."""
    for blocks in pieces(path, contents, topics):
        order = sorted((position, number, index) for number, block in enumerate(blocks)
                       for index, position in enumerate(block.positions))
        for _, number, index in order:
            block = blocks[number]
            yield Raw(block.topic, block.log_times[index], block.message(index))


def pieces(path: Path, contents: Contents, topics: Collection[str] | None = None,
           progress: Progress = lambda share: None) -> Iterator[list[Block]]:
    """
    Yield the messages of a bag (of these topics only) in the order of recording.

    They come in pieces, of each topic a block. contents is filled on the way, all but its
    messages. progress: receives the share of the bytes that were read. Raises BagError when
    there is nothing to read.
    """
    wanted = None if topics is None else {full_name(topic) for topic in topics}
    try:
        contents.files += _files(path, contents)
        sizes = [file.stat().st_size for file in contents.files]
        for index, file in enumerate(contents.files):
            done, total = sum(sizes[:index]), max(1, sum(sizes))
            for blocks in _of_file(file, contents, wanted):
                yield blocks
                progress(min(1.0, (done + min(contents.at, sizes[index])) / total))
    except OSError as error:
        raise BagError(error.filename or path, f'cannot be read: {error.strerror or error}'
                       ) from error
    if not contents.topics:
        why = '; '.join(contents.warnings) or 'the recording was stopped before it began'
        raise BagError(path, f'holds no messages ({why}): record again')


def _files(path: Path, contents: Contents) -> list[Path]:
    """Return the storage files of a bag in the order of recording."""
    if not path.exists():
        raise BagError(path, 'no such file or folder; expected a rosbag2 folder, or an .mcap or '
                             '.db3 file')
    if not path.is_dir():
        return [path]
    stored = sorted((p for p in path.iterdir() if p.name.endswith(SUFFIXES)), key=_natural)
    # whoever played a packed bag has left the unpacked file beside it
    stored = [p for p in stored if p.suffix != '.zstd' or p.with_suffix('') not in stored]
    if not stored:
        raise BagError(path, 'is not a bag: the folder holds no .mcap or .db3 file')
    try:
        content = yaml_content((path / 'metadata.yaml').read_text(encoding='utf-8'))
        names = [Path(p).name for p in content['rosbag2_bagfile_information'][
            'relative_file_paths']]
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError, RecursionError):
        contents.warnings.append(f'metadata.yaml is missing or damaged; read {len(stored)} '
                                 'storage file(s) of the folder')
        return stored
    listed = [path / name for name in names if (path / name).is_file()]
    if len(listed) < len(names):
        contents.warnings.append(f'{len(names) - len(listed)} of the {len(names)} files that '
                                 'metadata.yaml lists are missing')
    return listed or stored


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts bag_10 behind bag_9."""
    return [(int(part or 0), text) for text, part in re.findall(r'(\D*)(\d*)', path.name)]


def _of_file(path: Path, contents: Contents, wanted: set[str] | None
             ) -> Iterator[list[Block]]:
    """Yield the messages of one storage file; raises BagError for what is none."""
    folder = None
    magic, file = _magic(path), path
    if magic[:len(ZSTD)] == ZSTD:
        folder = tempfile.TemporaryDirectory(prefix='handeye-')
        file = _unpacked(path, Path(folder.name))
        magic = _magic(file) or ZSTD
    reader: McapFile | SqliteFile
    if magic == MCAP:
        reader = McapFile(file, path.name, contents, wanted)
    elif magic == SQLITE[:len(MCAP)]:
        reader = SqliteFile(file, path.name, contents, wanted)
    else:
        raise BagError(path, _not_a_bag(magic))
    if folder:  # as long as the messages may be asked for again
        weakref.finalize(reader, folder.cleanup)
    yield from reader.pieces()


def _magic(path: Path) -> bytes:
    with path.open('rb') as stream:
        return stream.read(len(MCAP))


def _unpacked(packed: Path, folder: Path) -> Path:
    """Return what a file that was packed as a whole holds, up to where it is damaged."""
    target = folder / packed.with_suffix('').name
    with packed.open('rb') as stream, target.open('wb') as file, suppress(zstandard.ZstdError):
        zstandard.ZstdDecompressor().copy_stream(stream, file)
    return target


def _not_a_bag(magic: bytes) -> str:
    if not magic:
        return 'the file is empty: record again'
    if magic == ROS1[:len(magic)]:
        return 'is a ROS 1 bag: convert it with rosbags-convert'
    return 'is not a bag; expected a rosbag2 folder, or an .mcap or .db3 file'


class SqliteFile:
    """
    Reads one database.

    In the order of recording: by time, a bag of two runs would look like one. SQLite refuses
    a file that is cut off, and rightly: what lies behind the cut would be read as zeros.
    """

    def __init__(self, path: Path, name: str, contents: Contents, wanted: set[str] | None
                 ) -> None:
        """name: for the warnings; wanted: the topics whose messages are given, None: all."""
        self._name = name
        self._contents = contents
        self._wanted = wanted
        self._path = self._with_its_log(path)

    def _with_its_log(self, path: Path) -> Path:
        """
        Return a database that holds what a recorder that was killed left in its write-ahead log.

        SQLite would put it into the file itself, but a recording is not ours to change.
        """
        log = path.with_name(f'{path.name}-wal')
        if not (log.exists() and log.stat().st_size):
            return path
        folder = tempfile.TemporaryDirectory(prefix='handeye-')
        weakref.finalize(self, folder.cleanup)  # until then messages may be asked for again
        copy = Path(folder.name) / path.name
        for file in (path, log):
            shutil.copyfile(file, copy.with_name(file.name))
        with suppress(sqlite3.DatabaseError), closing(sqlite3.connect(copy)) as connection:
            connection.execute('PRAGMA wal_checkpoint(TRUNCATE)')
        return copy

    def pieces(self) -> Iterator[list[Block]]:
        """Yield the messages in the order of recording: pieces with a block for each topic."""
        count, rows = 0, Gathered(self._message)
        try:
            with closing(self._connected()) as connection:
                names = self._topics(connection)
                marks = ', '.join('?' * len(names))
                for key, topic, time, data in connection.execute(
                        'SELECT id, topic_id, timestamp, data FROM messages '
                        f'WHERE topic_id IN ({marks}) ORDER BY id', list(names)):
                    rows.add(names[topic], int(time), bytes(data), key)
                    count += 1
                    self._contents.at += len(data)
                    if rows.is_full:
                        yield rows.take_blocks()
        except (sqlite3.Error, TypeError, ValueError, OverflowError) as error:
            self._contents.warnings.append(f'{self._name} is cut off or damaged ({error}): read '
                                           f'{count} messages up to there')
        yield rows.take_blocks()

    def _connected(self) -> sqlite3.Connection:
        return sqlite3.connect(f'{self._path.absolute().as_uri()}?immutable=1', uri=True)

    def _topics(self, connection: sqlite3.Connection) -> dict[int, str]:
        """Return the topics that are wanted, by their key in the database."""
        names = {}
        self._contents.at = 0
        for key, name, kind, encoding in connection.execute(
                'SELECT id, name, type, serialization_format FROM topics'):
            topic = full_name(str(name))
            self._contents.topics[topic] = type_of(str(kind), str(encoding))
            if self._wanted is None or topic in self._wanted:
                names[key] = topic
        return names

    def _message(self, key: int) -> bytes:
        try:
            with closing(self._connected()) as connection:
                (data,), = connection.execute('SELECT data FROM messages WHERE id = ?', (key,))
        except (sqlite3.Error, ValueError):
            return b''  # which is no message of any type
        return message_of(bytes(data))
