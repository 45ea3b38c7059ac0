"""The raw messages in a rosbag2 folder or file, as far as they can be read."""
from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from pathlib import Path
import re
import tempfile
import weakref

from handeye_ros.config import yaml_content
from handeye_ros.errors import BagError
from handeye_ros.ros.bags.blocks import Block, in_recorded_order
from handeye_ros.ros.bags.contents import Contents, full_name, Given, Raw, ZSTD
from handeye_ros.ros.bags.mcap_file import McapFile
from handeye_ros.ros.bags.sqlite_file import SqliteFile
import yaml
import zstandard

__all__ = ['Contents', 'messages', 'pieces', 'Raw', 'scan']

Progress = Callable[[float], None]

MCAP = b'\x89MCAP0\r\n'
SQLITE = b'SQLite format 3\0'
ROS1 = b'#ROSBAG V'

PIECE = 1 << 24  # bytes that are unpacked at a time

SUFFIXES = ('.mcap', '.db3', '.mcap.zstd', '.db3.zstd')


def scan(path: Path, topics: Collection[str] | None = None) -> Contents:
    """
    Return what a rosbag2 folder or an .mcap or .db3 file holds (of these topics only), at once.

    Raises BagError when there is nothing to read.

    """
    contents = Contents()
    contents.messages += [raw for raw, _ in messages(path, contents, topics)]
    return contents


def messages(path: Path, contents: Contents, topics: Collection[str] | None = None,
             progress: Progress = lambda share: None) -> Iterator[Given]:
    """Yield the messages of a bag one by one, each with what gives it again; see pieces."""
    for blocks in pieces(path, contents, topics, progress):
        yield from in_recorded_order(blocks)


def pieces(path: Path, contents: Contents, topics: Collection[str] | None = None,
           progress: Progress = lambda share: None) -> Iterator[list[Block]]:
    """
    Yield the messages of a bag (of these topics only) in the order of recording.

    They come in pieces, of each topic a block. contents is filled on the way, all but its
    messages. progress: told the share of the bytes that were read. Raises BagError when there is
    nothing to read.

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
    there = sorted((p for p in path.iterdir() if p.name.endswith(SUFFIXES)), key=_natural)
    # whoever played a packed bag has left the unpacked file beside it
    there = [p for p in there if p.suffix != '.zstd' or p.with_suffix('') not in there]
    if not there:
        raise BagError(path, 'is not a bag: the folder holds no .mcap or .db3 file')
    try:
        content = yaml_content((path / 'metadata.yaml').read_text(encoding='utf-8'))
        names = [Path(p).name for p in content['rosbag2_bagfile_information'][
            'relative_file_paths']]
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError, RecursionError):
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
    with packed.open('rb') as stream, target.open('wb') as file:
        reader = zstandard.ZstdDecompressor().stream_reader(stream)
        try:
            while piece := reader.read(PIECE):
                file.write(piece)
        except zstandard.ZstdError:
            pass
    return target


def _not_a_bag(magic: bytes) -> str:
    if not magic:
        return 'the file is empty: record again'
    if magic == ROS1[:len(magic)]:
        return 'is a ROS 1 bag: convert it with rosbags-convert'
    return 'is not a bag; expected a rosbag2 folder, or an .mcap or .db3 file'
