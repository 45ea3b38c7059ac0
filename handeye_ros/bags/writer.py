# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Writes rosbag2 folders: .mcap files with their metadata.yaml, and the messages in them.

Profiles and poses as drivers publish them, and paths.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
import json
import os
from pathlib import Path
import shutil
import tempfile
from types import MappingProxyType
from typing import Any, BinaryIO

from handeye_ros import se3
from handeye_ros.bags.messages import DATATYPES, typestore
from handeye_ros.bags.storage import (
    by_log_time,
    CLOUD_TYPE,
    full_name,
    JOINTS_TYPE,
    POSE_TYPE,
    RecordedMessage,
    STRING_TYPE,
)
from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Array, NS, Profile, RawProfile, TimedPose
from handeye_ros.errors import InputError
from handeye_ros.output import write_atomically, write_errors_for
from handeye_ros.results.truth import TRUTH_NAME
from handeye_ros.units import UNITS
from mcap.reader import make_reader
from mcap.summary import Summary
from mcap.writer import CompressionType, Writer
import numpy as np

METADATA = 'metadata.yaml'
OWN_FILES = (METADATA, TRUTH_NAME)  # a folder with one of these may be replaced
CHUNK_BYTES = 1 << 20  # bytes of a chunk: a reader decompresses one to read a message
PATH_TYPE, POSE_ARRAY_TYPE = 'nav_msgs/msg/Path', 'geometry_msgs/msg/PoseArray'


def write(path: Path, profiles: Iterable[Profile], poses: Iterable[TimedPose],
          config: Config | None = None, *, texts: Mapping[str, str] = MappingProxyType({}),
          force: bool = False, joints: Sequence[tuple[int, Array]] = (), dtype: str = 'f4'
          ) -> None:
    """
    Write profiles and poses as a rosbag2 folder, completely or not at all.

    config: names the topics, and the unit of the coordinates in the messages
    texts: the contents of other files in the folder, by name
    force: whether a bag that is there is replaced
    joints: stamps (ns) and values (k,) of the joints joint_1, joint_2 and so on (rad or m)
    dtype: the type of the coordinates, f4 or f8

    Raises InputError if the path exists and may not be replaced, and UnwritableError if it cannot
    be written.
    """
    config = config or Config()

    def fill(folder: Path) -> None:
        items: list[AnyProfile | TimedPose] = [*profiles, *poses]
        messages = [recorded_message(item, config, dtype) for item in items]
        messages += [RecordedMessage(full_name(config.joint_topic), JOINTS_TYPE, stamp,
                                     joints_cdr(stamp, values)) for stamp, values in joints]
        _write_bag(folder, sorted(messages, key=by_log_time))

    write_folder(path, texts, fill, force)


def recorded_message(item: AnyProfile | TimedPose, config: Config, dtype: str) -> RecordedMessage:
    """Return a profile or pose as it is recorded; dtype: type of the coordinates, f4 or f8."""
    if isinstance(item, TimedPose):
        return RecordedMessage(full_name(config.pose_topic), POSE_TYPE, item.stamp, pose_cdr(item))
    data = (bytes(item.fetch()) if isinstance(item, RawProfile)
            else cloud_cdr(item, config.profile.unit, dtype))
    return RecordedMessage(full_name(config.profile_topic), CLOUD_TYPE, item.stamp, data)


def _write_bag(path: Path, messages: Iterable[RecordedMessage]) -> None:
    """Make a folder with one .mcap file of the messages, and with metadata.yaml."""
    path.mkdir()
    file = path / f'{path.name}.mcap'
    with file.open('wb') as stream:
        write_mcap(stream, messages)
    write_metadata(path, [file])


def write_mcap(stream: BinaryIO, messages: Iterable[RecordedMessage]) -> None:
    """Write messages, in the order of their times, as an .mcap file; raises OSError."""
    writer = Writer(stream, CHUNK_BYTES, CompressionType.ZSTD)
    writer.start('ros2', 'handeye_ros')
    channels: dict[str, int] = {}
    for message in messages:
        if message.topic not in channels:
            text, _ = typestore().generate_msgdef(message.message_type, ros_version=2)
            schema = writer.register_schema(message.message_type, 'ros2msg', text.encode())
            channels[message.topic] = writer.register_channel(
                message.topic, 'cdr', schema, {'offered_qos_profiles': ''})
        writer.add_message(channels[message.topic], message.log_time, message.data,
                           message.log_time)
    writer.finish()


def summary_of(file: Path) -> Summary:
    """Return the summary of a whole .mcap file, with statistics; raises InputError."""
    try:
        summary = _contents(file, file.stat().st_mtime_ns)
        if summary and summary.statistics:
            return summary
    except Exception as error:  # damaged bytes cause all kinds of errors in parsers
        raise InputError(f'{file}: is damaged, or cannot be read: {error}') from error
    raise InputError(f'{file}: is cut off')


@lru_cache(10_000)
def _contents(file: Path, written: int) -> Summary | None:
    """Return the summary of a file; written: when it was changed (ns), as a key of the cache."""
    with file.open('rb') as stream:
        return make_reader(stream).get_summary()


def write_metadata(folder: Path, files: Sequence[Path]) -> None:
    """
    Write metadata.yaml, atomically, and sync the names of files; raises OSError, InputError.

    JSON is YAML, and is written 100 times faster.
    """
    parts = [summary_of(file) for file in files]
    message_types, counts = dict[str, str](), Counter[str]()
    for part in parts:
        for channel_id, channel in part.channels.items():
            message_types[channel.topic] = part.schemas[channel.schema_id].name
            counts[channel.topic] += part.statistics.channel_message_counts.get(channel_id, 0)
    information = {
        'version': 9, 'storage_identifier': 'mcap', 'ros_distro': 'jazzy', **_span(parts),
        'topics_with_message_count': [
            {'message_count': counts[topic], 'topic_metadata': {
                'name': topic, 'type': message_type, 'serialization_format': 'cdr',
                'offered_qos_profiles': [], 'type_description_hash': ''}}
            for topic, message_type in message_types.items()],
        'compression_format': '', 'compression_mode': '',
        'relative_file_paths': [file.name for file in files],
        'files': [{'path': file.name, **_span([part])}
                  for file, part in zip(files, parts, strict=True)],
        'custom_data': None}
    write_atomically(folder / METADATA, json.dumps({'rosbag2_bagfile_information': information},
                                                   indent=1))
    sync(folder)


def _span(parts: Sequence[Summary]) -> dict[str, Any]:
    """Return the time and the number of messages as in metadata.yaml; parts: one of each file."""
    statistics = [part.statistics for part in parts]
    first = min(counts.message_start_time for counts in statistics)
    last = max(counts.message_end_time for counts in statistics)
    return {'duration': {'nanoseconds': last - first},
            'message_count': sum(counts.message_count for counts in statistics),
            'starting_time': {'nanoseconds_since_epoch': first}}


def sync(path: Path) -> None:
    """Write a file, or the names in a folder, through to the disk; raises OSError."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def to_cdr(message: Any) -> bytes:
    """Return a message of the typestore, serialised as ROS does (CDR)."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def pose_cdr(pose: TimedPose) -> bytes:
    """Return a pose as a serialised geometry_msgs/PoseStamped."""
    header = _header(pose.stamp, pose.parent_frame)
    return to_cdr(_new(POSE_TYPE, header, _pose(pose.translation, pose.quaternion)))


def string_cdr(text: str) -> bytes:
    """Return a text as a serialised std_msgs/String."""
    return to_cdr(_new(STRING_TYPE, text))


def cloud_cdr(profile: Profile, unit: str = 'm', dtype: str = 'f4') -> bytes:
    """
    Return a profile as a serialised sensor_msgs/PointCloud2 with the fields x, y and z.

    unit: of the coordinates; dtype: their type, f4 or f8.
    """
    points = np.zeros((len(profile.points), 3), f'<{dtype}')
    for axis, column in zip(profile.axes, profile.points.T / UNITS['m'][unit], strict=True):
        points[:, 'xyz'.index(axis[-1])] = -column if axis[0] == '-' else column
    size, (code,) = points.itemsize, [k for k, name in DATATYPES.items() if name == dtype]
    fields = [_new('sensor_msgs/msg/PointField', axis, k * size, code, 1)
              for k, axis in enumerate('xyz')]
    return to_cdr(_new(
        CLOUD_TYPE, _header(profile.stamp, profile.frame_id), 1, len(points), fields, False,
        3 * size, points.nbytes, points.view(np.uint8).ravel(),
        bool(np.isfinite(profile.points).all())))


def _new(message_type: str, *values: Any) -> Any:
    """Return a message of a type; values: of all its fields, in the order of the definition."""
    return typestore().types[message_type](*values)


def _header(stamp: int, frame_id: str) -> Any:
    time = _new('builtin_interfaces/msg/Time', *divmod(stamp, NS))
    return _new('std_msgs/msg/Header', time, frame_id)


def joints_cdr(stamp: int, values: Array) -> bytes:
    """Return a serialised JointState of joint_1, joint_2, ...; values: (joints,) (rad or m)."""
    names, empty = [f'joint_{k}' for k in range(1, len(values) + 1)], np.zeros(0)
    return to_cdr(_new(JOINTS_TYPE, _header(stamp, ''), names, values, empty, empty))


def _pose(translation: Array, quaternion: Array) -> Any:
    return _new('geometry_msgs/msg/Pose',
                _new('geometry_msgs/msg/Point', *map(float, translation)),
                _new('geometry_msgs/msg/Quaternion', *map(float, quaternion)))


def write_path(path: Path, T: Array, frame_id: str, stamp: int) -> None:
    """
    Write a bag with poses T (n, 4, 4) of the frame frame_id on /seam/path and /seam/poses.

    Both messages have the stamp (ns). A bag that is there is replaced. Raises InputError if there
    is something else, and UnwritableError.
    """
    header = _header(stamp, frame_id)
    poses = [_pose(*pair) for pair in zip(T[:, :3, 3], se3.quaternion(T), strict=True)]
    stamped = [_new(POSE_TYPE, header, pose) for pose in poses]
    messages = [RecordedMessage(topic, message.__msgtype__, stamp, to_cdr(message))
                for topic, message in (
        ('/seam/path', _new(PATH_TYPE, header, stamped)),
        ('/seam/poses', _new(POSE_ARRAY_TYPE, header, poses)))]
    write_folder(path, {}, lambda folder: _write_bag(folder, messages), force=True)


def write_folder(path: Path, texts: Mapping[str, str],
                 fill: Callable[[Path], None] = Path.mkdir, force: bool = False) -> None:
    """
    Write a folder of recordings or measured values, completely or not at all.

    A hidden folder beside the final one is filled and then renamed. If the process is killed
    between the two renames that replace a recording, both are in the hidden folder. texts: of
    files, by name; fill: makes the folder, with all its other files; force: an existing recording
    is replaced. Raises InputError if the path exists and may not be replaced, UnwritableError.
    """
    path = path.resolve()
    with write_errors_for(path):
        _require_free(path, force)
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix='.', suffix='.tmp', dir=path.parent) as folder:
            new_folder = Path(folder) / 'new' / path.name
            new_folder.parent.mkdir()
            fill(new_folder)
            for name, text in texts.items():
                (new_folder / name).write_text(text, encoding='utf-8')
            if path.exists():  # it is deleted with the temporary folder
                shutil.move(path, Path(folder) / 'replaced')
            new_folder.rename(path)


def _require_free(path: Path, force: bool) -> None:
    """Raise InputError where a folder cannot be made, or replaced if force."""
    if not path.exists() or path.is_dir() and not any(path.iterdir()):
        return
    if not force:
        raise InputError(f'{path}: is there already: choose another place, or replace it with '
                         '--force')
    if not any((path / name).is_file() for name in OWN_FILES):
        raise InputError(f'{path}: is there already and is no bag, so it is not replaced: choose '
                         'another place')
    if path == Path.cwd():  # a shell in it would lose its folder
        raise InputError(f'{path}: is the current folder, which is not replaced: name one in it')
