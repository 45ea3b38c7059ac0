"""
The files of a session: each is written completely or not at all.

A file is written under another name, synced, and renamed; then metadata.yaml is written under
another name and renamed, and the folder is synced. If the process is killed at any time, all files
are complete bags, and metadata.yaml lists all of them except perhaps the last, which the node has
not yet reported. After a power failure metadata.yaml may be older: it is synced later, repeats
only data of the files, and is written again when the session is continued.
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
import json
import os
from pathlib import Path
import re
from typing import Any

from handeye_ros.bags.bag_write import typestore
from handeye_ros.bags.reader import Raw
from handeye_ros.errors import BagError
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

SUFFIX = '.mcap'
METADATA = 'metadata.yaml'
CHUNK = 1 << 22  # bytes of a chunk: a reader decompresses one to read a message
INFORMATION = """\
rosbag2_bagfile_information:
  version: 9
  storage_identifier: mcap
  duration:
    nanoseconds: {length}
  starting_time:
    nanoseconds_since_epoch: {first}
  message_count: {count}
  topics_with_message_count:
{topics}\
  compression_format: ''
  compression_mode: ''
  relative_file_paths:
{names}\
  files:
{files}\
  custom_data: null
  ros_distro: jazzy
"""
TOPIC = """\
  - topic_metadata:
      name: {name}
      type: {type}
      serialization_format: cdr
      offered_qos_profiles: []
      type_description_hash: {hash}
    message_count: {count}
"""
FILE = """\
  - path: {name}
    starting_time:
      nanoseconds_since_epoch: {first}
    duration:
      nanoseconds: {length}
    message_count: {count}
"""


@dataclass(frozen=True)
class BagFile:
    """The entry of a file in metadata.yaml: first and last time in ns, counts by topic."""

    name: str
    first: int
    last: int
    counts: dict[str, int]


def write_file(path: Path, messages: Sequence[Raw], types: dict[str, str]) -> BagFile:
    """
    Write messages as an .mcap file, completely or not at all; types: by topic. Raises OSError.

    Its name is on the disk after the folder is synced by write_metadata.
    """
    temporary = path.with_name(f'.{path.name}.tmp')
    try:
        with temporary.open('wb') as stream:  # may replace the rest of a killed process
            _write_messages(stream, messages, types)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except OSError:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    return _entry(path.name, messages)


@dataclass(frozen=True)
class Content:
    """Content of a file: its entry in metadata.yaml, types by topic, and messages."""

    file: BagFile
    types: dict[str, str]
    messages: list[Raw]


def read_file(path: Path, topics: Sequence[str] = ()) -> Content:
    """Return a file with its messages, of these topics or all; raises BagError."""
    try:
        with path.open('rb') as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                raise BagError(path, 'is cut off')
            topic_of = {channel.id: channel.topic for channel in summary.channels.values()}
            types = {channel.topic: summary.schemas[channel.schema_id].name
                     for channel in summary.channels.values()}
            statistics = summary.statistics
            counts = {topic_of[number]: count
                      for number, count in statistics.channel_message_counts.items()}
            messages = [Raw(channel.topic, message.log_time, message.data)
                        for _, channel, message in reader.iter_messages(topics or None)]
    except OSError as error:
        raise BagError(path, f'cannot be read: {error.strerror or error}') from error
    except BagError:
        raise
    except Exception as error:  # damaged bytes cause all kinds of errors in parsers
        raise BagError(path, f'is damaged: {error}') from error
    file = BagFile(path.name, statistics.message_start_time, statistics.message_end_time, counts)
    return Content(file, types, messages)


def _entry(name: str, messages: Iterable[Raw]) -> BagFile:
    """Return the entry of metadata.yaml for a file with these messages."""
    times, counts = [], dict[str, int]()
    for message in messages:
        times.append(message.log_time)
        counts[message.topic] = counts.get(message.topic, 0) + 1
    return BagFile(name, min(times, default=0), max(times, default=0), counts)


def _write_messages(stream: Any, messages: Sequence[Raw], types: dict[str, str]) -> None:
    writer = Writer(stream, CHUNK, CompressionType.ZSTD)
    writer.start('ros2', 'handeye_ros')
    channels = {}
    for topic, kind in types.items():
        text, _ = typestore().generate_msgdef(kind, ros_version=2)
        schema = writer.register_schema(kind, 'ros2msg', text.encode())
        channels[topic] = writer.register_channel(topic, 'cdr', schema,
                                                  {'offered_qos_profiles': ''})
    for message in sorted(messages, key=lambda message: message.log_time):
        writer.add_message(channels[message.topic], message.log_time, message.data,
                           message.log_time)
    writer.finish()


def write_metadata(folder: Path, files: Sequence[BagFile], types: dict[str, str]) -> None:
    """Write metadata.yaml, atomically, and sync the names of files; raises OSError."""
    temporary = folder / f'.{METADATA}.tmp'
    temporary.write_text(_metadata(files, types), encoding='utf-8')
    os.replace(temporary, folder / METADATA)
    sync(folder)


def _metadata(files: Sequence[BagFile], types: dict[str, str]) -> str:
    """Return the text of metadata.yaml, 100 times faster than a YAML library."""
    first, last = min(file.first for file in files), max(file.last for file in files)
    counts = {topic: sum(file.counts.get(topic, 0) for file in files) for topic in types}
    topics = [TOPIC.format(name=json.dumps(topic), type=kind, hash=_hash(kind),
                           count=counts[topic]) for topic, kind in types.items()]
    return INFORMATION.format(
        length=last - first, first=first, count=sum(counts.values()), topics=''.join(topics),
        names=''.join([f'  - {json.dumps(file.name)}\n' for file in files]),
        files=''.join([FILE.format(name=json.dumps(file.name), first=file.first,
                                   length=file.last - file.first,
                                   count=sum(file.counts.values())) for file in files]))


@cache
def _hash(kind: str) -> str:
    """Return the type hash (REP 2011) of a message type."""
    return str(typestore().hash_rihs01(kind))


def sync(path: Path) -> None:
    """Write a file, or the names in a folder, through to the disk; raises OSError."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def number_of(name: str) -> int:
    """Return the number of a file in its session, -1 for the name of another file."""
    match = re.search(rf'_(\d+){re.escape(SUFFIX)}$', name)
    return int(match[1]) if match and not name.startswith('.') else -1


def files_of(folder: Path) -> list[Path]:
    """Return the files of a session in the order of their numbers; raises OSError."""
    files = [path for path in folder.iterdir() if number_of(path.name) >= 0]
    return sorted(files, key=lambda path: number_of(path.name))
