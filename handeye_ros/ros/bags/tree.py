"""The flange poses that the transforms in a bag hold."""
from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from handeye_ros.config import Config
from handeye_ros.data import TimedPose
from handeye_ros.errors import BagError
from handeye_ros.ros.bags.blocks import Block
from handeye_ros.ros.bags.contents import Contents, TF
from handeye_ros.ros.bags.held import Added, one_by_one
from handeye_ros.ros.bags.messages import stamp_of
from handeye_ros.ros.bags.topic import in_their_order, Topic
from handeye_ros.ros.bags.transforms import FlangeTracker, well_formed
from handeye_ros.ros.errors import MessageError
from rosbags.serde import SerdeError


class Transforms:
    """The transforms of each message that can be understood."""

    def __init__(self) -> None:
        """Start with none."""
        self.messages: list[Any] = []

    def add(self, block: Block) -> Added:
        """Take the next messages; their stamps are the times at which they were received."""
        def one(index: int) -> int:
            self.take(block.message(index))
            return block.log_times[index]

        return one_by_one(block, one)

    def take(self, data: bytes) -> None:
        """Take the next message; raises MessageError."""
        try:
            message: Any = _types().deserialize_cdr(data, TF)
        except (SerdeError, IndexError, ValueError) as error:
            raise MessageError('TFMessage', f'damaged message: {error}') from error
        self.messages.append([transform for transform, _ in well_formed(message.transforms)])

    def chosen(self, order: Sequence[int], stamps: Sequence[int]) -> list[Any]:
        """Return the transforms of messages in an order."""
        return [self.messages[index] for index in order]


class Tree:
    """The topics of transforms."""

    def __init__(self) -> None:
        """Start with none."""
        self._moving, self._static = Transforms(), Transforms()
        self.topics = (Topic('pose_source', '/tf', TF, self._moving),
                       Topic('pose_source', '/tf_static', TF, self._static))

    def poses(self, path: Path, contents: Contents, config: Config) -> list[TimedPose]:
        """Return the flange poses; raises BagError, and what Topic.items does."""
        tracker = FlangeTracker(config.base_frame, config.robot_effector_frame)
        moving, static = self.topics
        if static.name in contents.topics:
            # all at once: those of a late node must not come after the motion they belong to
            static.require(path, contents, may_be_empty=True)
            for transforms in self._static.messages:
                tracker.add(transforms, static=True)
        moving.require(path, contents)
        fitting = self._fitting(contents)
        poses = [pose for transforms in self._moving.messages
                 for pose in tracker.add([t for t in transforms if id(t) in fitting],
                                         static=False)]
        if not poses:
            raise BagError(path, 'no flange poses in its transforms: '
                           + (tracker.missing() or 'they share no time')
                           + '; set robot_base_frame and robot_effector_frame')
        return poses

    def _fitting(self, contents: Contents) -> set[int]:
        """Return the ids of the transforms whose stamps fit those of the same frame."""
        of_frame: dict[str, list[tuple[int, Any]]] = {}
        for transforms in self._moving.messages:
            for t in transforms:
                of_frame.setdefault(t.child_frame_id, []).append((stamp_of(t.header), t))
        return {id(t) for child, stamped in of_frame.items()
                for t in in_their_order(f'/tf (frame {child})', stamped, contents)}


@cache
def _types() -> Any:
    """Return the types of messages; most bags need none of them, and their import takes long."""
    from rosbags.typesys import get_typestore, Stores
    return get_typestore(Stores.ROS2_JAZZY)
