"""Raw messages of a rosbag2 folder or file, as far as they are readable."""
from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import closing, suppress
from pathlib import Path
import re
import shutil
import sqlite3
import tempfile
import weakref

from handeye_ros.bags.contents import (
    Block,
    BlockBuilder,
    Contents,
    full_name,
    message_of,
    Raw,
    type_of,
    ZSTD,
)
from handeye_ros.bags.mcap_file import McapFile
from handeye_ros.config import yaml_content
from handeye_ros.errors import BagError
import yaml
import zstandard

Progress = Callable[[float], None]

MCAP = b'\x89MCAP0\r\n'
SQLITE = b'SQLite format 3\0'
ROS1 = b'#ROSBAG V'

SUFFIXES = ('.mcap', '.db3', '.mcap.zstd', '.db3.zstd')


def scan(path: Path, topics: Collection[str] | None = None) -> Contents:
    """Return the contents of a bag with its messages (of given topics); see block_groups."""
    contents = Contents()
    contents.messages += messages(path, contents, topics)
    return contents


def messages(path: Path, contents: Contents, topics: Collection[str] | None = None
             ) -> Iterator[Raw]:
    """Yield the messages of a bag one by one; see block_groups."""
    for blocks in block_groups(path, contents, topics):
        order = sorted((position, number, index) for number, block in enumerate(blocks)
                       for index, position in enumerate(block.positions))
        for _, number, index in order:
            block = blocks[number]
            yield Raw(block.topic, block.log_times[index], block.message(index))


def block_groups(path: Path, contents: Contents, topics: Collection[str] | None = None,
                 progress: Progress = lambda share: None) -> Iterator[list[Block]]:
    """
    Yield the messages of a bag (of given topics) in recording order.

    Each list has a block for each topic. contents is filled meanwhile, except its messages.
    progress: receives the fraction of the bytes that were read. Raises BagError if there is
    nothing to read.
    """
    names = None if topics is None else {full_name(topic) for topic in topics}
    try:
        contents.files += _files(path, contents)
        sizes = [file.stat().st_size for file in contents.files]
        for index, file in enumerate(contents.files):
            done, total = sum(sizes[:index]), max(1, sum(sizes))
            for blocks in _file_blocks(file, contents, names):
                yield blocks
                progress(min(1.0, (done + min(contents.position, sizes[index])) / total))
    except OSError as error:
        raise BagError(error.filename or path, f'cannot be read: {error.strerror or error}'
                       ) from error
    if not contents.topics:
        reason = '; '.join(contents.warnings) or 'the recording was stopped before it began'
        raise BagError(path, f'holds no messages ({reason}): record again')


def _files(path: Path, contents: Contents) -> list[Path]:
    """Return the storage files of a bag in recording order."""
    if not path.exists():
        raise BagError(path, 'no such file or folder; expected a rosbag2 folder, or an .mcap or '
                             '.db3 file')
    if not path.is_dir():
        return [path]
    stored = sorted((p for p in path.iterdir() if p.name.endswith(SUFFIXES)), key=_natural)
    # playing a compressed bag leaves the decompressed file beside it
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
    """Return a sort key with bag_10 after bag_9."""
    return [(int(digits or 0), text) for text, digits in re.findall(r'(\D*)(\d*)', path.name)]


def _file_blocks(path: Path, contents: Contents, topics: set[str] | None
                 ) -> Iterator[list[Block]]:
    """Yield the messages of one storage file; raises BagError for other files."""
    folder = None
    magic, file = _magic(path), path
    if magic[:len(ZSTD)] == ZSTD:
        folder = tempfile.TemporaryDirectory(prefix='handeye-')
        file = _unpacked(path, Path(folder.name))
        magic = _magic(file) or ZSTD
    reader: McapFile | SqliteFile
    if magic == MCAP:
        reader = McapFile(file, path.name, contents, topics)
    elif magic == SQLITE[:len(MCAP)]:
        reader = SqliteFile(file, path.name, contents, topics)
    else:
        raise BagError(path, _not_a_bag(magic))
    if folder:  # kept while messages may be read again
        weakref.finalize(reader, folder.cleanup)
    yield from reader.block_groups()


def _magic(path: Path) -> bytes:
    with path.open('rb') as stream:
        return stream.read(len(MCAP))


def _unpacked(packed: Path, folder: Path) -> Path:
    """Return the decompressed file, up to a damage."""
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

    In the order of recording: by time, a bag of two runs would look like one. SQLite refuses a
    truncated file.
    """

    def __init__(self, path: Path, name: str, contents: Contents, topics: set[str] | None
                 ) -> None:
        """name: for the warnings; topics: the requested ones, None: all."""
        self._name = name
        self._contents = contents
        self._requested = topics
        self._path = self._with_its_log(path)

    def _with_its_log(self, path: Path) -> Path:
        """
        Return a database including the write-ahead log of a killed recorder.

        SQLite would merge it into the file itself, but the recording must not be changed.
        """
        log = path.with_name(f'{path.name}-wal')
        if not (log.exists() and log.stat().st_size):
            return path
        folder = tempfile.TemporaryDirectory(prefix='handeye-')
        weakref.finalize(self, folder.cleanup)  # kept while messages may be read again
        copy = Path(folder.name) / path.name
        for file in (path, log):
            shutil.copyfile(file, copy.with_name(file.name))
        with suppress(sqlite3.DatabaseError), closing(sqlite3.connect(copy)) as connection:
            connection.execute('PRAGMA wal_checkpoint(TRUNCATE)')
        return copy

    def block_groups(self) -> Iterator[list[Block]]:
        """Yield the messages in recording order: lists with a block for each topic."""
        count, rows = 0, BlockBuilder(self._message)
        try:
            with closing(self._connected()) as connection:
                names = self._topics(connection)
                marks = ', '.join('?' * len(names))
                for key, topic, time, data in connection.execute(
                        'SELECT id, topic_id, timestamp, data FROM messages '
                        f'WHERE topic_id IN ({marks}) ORDER BY id', list(names)):
                    rows.add(names[topic], int(time), bytes(data), key)
                    count += 1
                    self._contents.position += len(data)
                    if rows.is_full:
                        yield rows.take_blocks()
        except (sqlite3.Error, TypeError, ValueError, OverflowError) as error:
            self._contents.warnings.append(f'{self._name} is cut off or damaged ({error}): read '
                                           f'{count} messages up to there')
        yield rows.take_blocks()

    def _connected(self) -> sqlite3.Connection:
        return sqlite3.connect(f'{self._path.absolute().as_uri()}?immutable=1', uri=True)

    def _topics(self, connection: sqlite3.Connection) -> dict[int, str]:
        """Return the requested topics by their key in the database."""
        names = {}
        self._contents.position = 0
        for key, name, kind, encoding in connection.execute(
                'SELECT id, name, type, serialization_format FROM topics'):
            topic = full_name(str(name))
            self._contents.topics[topic] = type_of(str(kind), str(encoding))
            if self._requested is None or topic in self._requested:
                names[key] = topic
        return names

    def _message(self, key: int) -> bytes:
        try:
            with closing(self._connected()) as connection:
                (data,), = connection.execute('SELECT data FROM messages WHERE id = ?', (key,))
        except (sqlite3.Error, ValueError):
            return b''  # no message of any type
        return message_of(bytes(data))
