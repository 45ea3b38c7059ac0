"""Writes a path as a rosbag2 folder: one nav_msgs/Path and one geometry_msgs/PoseArray."""
from __future__ import annotations

from pathlib import Path

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.results import folder
from handeye_ros.ros.bags.contents import full_name
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

PATH, POSES = 'nav_msgs/msg/Path', 'geometry_msgs/msg/PoseArray'


def write_path(path: Path, T: Array, frame_id: str, stamp: int, name: str = 'seam',
               force: bool = False) -> None:
    """
    Write poses (n, 4, 4) on the topics NAME/path and NAME/poses.

    stamp: of the messages (ns). Raises BagError when there is something at path, UnwritableError.
    """
    types = get_typestore(Stores.ROS2_JAZZY)
    kinds = types.types
    header = kinds['std_msgs/msg/Header'](
        kinds['builtin_interfaces/msg/Time'](*divmod(stamp, 1_000_000_000)), frame_id)
    poses = [kinds['geometry_msgs/msg/Pose'](
        kinds['geometry_msgs/msg/Point'](*map(float, T_one[:3, 3])),
        kinds['geometry_msgs/msg/Quaternion'](*map(float, q)))
        for T_one, q in zip(T, se3.quaternion(T), strict=True)]
    stamped = [kinds['geometry_msgs/msg/PoseStamped'](header, pose) for pose in poses]

    def fill(made: Path) -> None:
        with Writer(made, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            for topic, kind, message in (('path', PATH, kinds[PATH](header, stamped)),
                                         ('poses', POSES, kinds[POSES](header, poses))):
                connection = writer.add_connection(full_name(f'{name}/{topic}'), kind,
                                                   typestore=types)
                writer.write(connection, stamp, types.serialize_cdr(message, kind))

    folder.write(path, {}, fill, force)
