"""
Flange poses from the transform tree.

tf2_ros looks up one transform at one time; this module gives every change of the flange as a pose
at its own stamp. Links with other stamps are interpolated to it, never extrapolated. Imports no
ROS.
"""
from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from handeye_ros import se3
from handeye_ros.bags.contents import Block, Contents, TF
from handeye_ros.bags.messages import deserialised, pose_from_transform, stamp_of
from handeye_ros.bags.topic import Added, added_singly, in_their_order, Topic
from handeye_ros.config import Config
from handeye_ros.data import Array, TimedPose
from handeye_ros.errors import BagError
from handeye_ros.node.errors import MessageError
from handeye_ros.sampling.stream import interpolate, Stream
import numpy as np

MOST_FRAMES = 1000  # with stored transforms
KEPT = 1000  # transforms of a link: 10 s of a robot driver at 100 Hz


class Link:
    """The transforms of a frame in its parent, in the order of their stamps."""

    def __init__(self, parent: str, static: bool) -> None:
        """Start with none."""
        self.parent = parent
        self.static = static
        self._poses: deque[TimedPose] = deque(maxlen=1 if static else KEPT)
        self._stream: Stream[TimedPose] = Stream('transform')

    def add(self, pose: TimedPose) -> None:
        """Add the next transform; older ones are dropped, static ones replaced."""
        self._poses.extend([pose] if self.static else self._stream.add(pose, self.parent))

    @property
    def set_back(self) -> bool:
        """Return whether its clock was set back."""
        return bool(self._stream.set_back)

    def stamps(self, since: int) -> list[int]:
        """Return the stamps later than since."""
        return [p.stamp for p in self._poses if p.stamp > since]

    def at(self, stamp: int) -> Array | None:
        """Return T_parent_child (4, 4) at a stamp; None if it is too new, or too old."""
        poses = self._poses
        if self.static:
            return se3.from_quaternion(poses[0].translation, poses[0].quaternion)
        if not poses or not poses[0].stamp <= stamp <= poses[-1].stamp:
            return None
        index = bisect_left(poses, stamp, key=lambda pose: pose.stamp)
        if poses[index].stamp == stamp:
            return se3.from_quaternion(poses[index].translation, poses[index].quaternion)
        return interpolate([poses[index - 1], poses[index]], [stamp])[0]


def valid_transforms(transforms: Any) -> list[tuple[Any, TimedPose]]:
    """
    Return the valid transforms of one message, each with its pose.

    Raises MessageError if all are invalid: an unused invalid frame must not affect the others.
    """
    good, malformed = [], None
    for transform in transforms:
        try:
            good.append((transform, pose_from_transform(transform)))
        except MessageError as error:
            malformed = error
    if malformed and not good:
        raise malformed
    return good


class FlangeTracker:
    """Computes flange poses in the base from transforms, at the times of the last joint."""

    def __init__(self, base: str, flange: str) -> None:
        """Start with an empty tree."""
        self._base = _name(base)
        self._flange = _name(flange)
        self._links: dict[str, Link] = {}
        self._sent_until = -1

    def add(self, transforms: Any, static: bool) -> list[TimedPose]:
        """
        Add the transforms of one message; return the poses that are now known.

        Raises MessageError when all are malformed, or of more frames than any robot has.
        """
        for transform, pose in valid_transforms(transforms):
            child, parent = _name(transform.child_frame_id), _name(pose.parent_frame)
            link = self._links.get(child)
            if link is None and len(self._links) >= MOST_FRAMES:
                raise MessageError('TransformStamped', f'it is of frame "{child}", one more than '
                                   f'the {MOST_FRAMES} that are followed')
            if link is None or (link.parent, link.static) != (parent, static):
                link = self._links[child] = Link(parent, static)
            link.add(pose)
            if link.set_back:
                self.restart()
        return self._new_poses()

    def restart(self) -> None:
        """Forget moving transforms, so that times may start again; static ones stay."""
        self._links = {child: link for child, link in self._links.items() if link.static}
        self._sent_until = -1

    def missing(self) -> str:
        """Return why there are no poses, '' if there are."""
        chains = self._chains()
        if chains is None:
            frames = sorted({*self._links, *(link.parent for link in self._links.values())})
            return (f'no chain of transforms leads from "{self._base}" to "{self._flange}"; '
                    f'frames received: {", ".join(frames) or "none"}')
        if not self._moving(chains):
            return f'all transforms between "{self._base}" and "{self._flange}" are static'
        return ''

    def _new_poses(self) -> list[TimedPose]:
        chains = self._chains()
        if not chains or not (moving := self._moving(chains)):
            return []
        poses = []
        for stamp in moving[0].stamps(self._sent_until):
            T_meet_flange, T_meet_base = (_product(chain, stamp) for chain in chains)
            if T_meet_flange is not None and T_meet_base is not None:
                T_base_flange = se3.inverse(T_meet_base) @ T_meet_flange
                poses.append(TimedPose(stamp, T_base_flange[:3, 3],
                                       se3.quaternion(T_base_flange), self._base))
                self._sent_until = stamp
        return poses

    def _moving(self, chains: tuple[list[Link], list[Link]]) -> list[Link]:
        return [link for chain in chains for link in chain if not link.static]

    def _chains(self) -> tuple[list[Link], list[Link]] | None:
        """Return the links from flange and base up to their common ancestor."""
        from_flange, from_base = self._ancestors(self._flange), self._ancestors(self._base)
        ancestor = next((frame for frame in from_flange if frame in from_base), None)
        if ancestor is None:
            return None
        flange_chain, base_chain = (
            [self._links[frame] for frame in frames[:frames.index(ancestor)]]
            for frames in (from_flange, from_base))
        return flange_chain, base_chain

    def _ancestors(self, frame: str) -> list[str]:
        """Return a frame and its ancestors; stops at a loop."""
        frames = [frame]
        while frames[-1] in self._links and self._links[frames[-1]].parent not in frames:
            frames.append(self._links[frames[-1]].parent)
        return frames


def _product(chain: list[Link], stamp: int) -> Array | None:
    """Return the pose of the chain's first frame in its last parent; None if unknown."""
    product = np.eye(4)
    for link in chain:
        T = link.at(stamp)
        if T is None:
            return None
        product = T @ product
    return product


def _name(frame: str) -> str:
    return frame.removeprefix('/')


class Transforms:
    """The valid transforms of each message."""

    def __init__(self) -> None:
        """Start with none."""
        self.messages: list[Any] = []

    def add(self, block: Block) -> Added:
        """Add the next messages; their stamps are the times of receipt."""
        def one(index: int) -> int:
            self.take(block.message(index))
            return block.log_times[index]

        return added_singly(block, one)

    def take(self, data: bytes) -> None:
        """Add the next message; raises MessageError."""
        transforms = deserialised(data, TF).transforms
        self.messages.append([transform for transform, _ in valid_transforms(transforms)])

    def chosen(self, order: Sequence[int], stamps: Sequence[int]) -> list[Any]:
        """Return the transforms of messages in an order."""
        return [self.messages[index] for index in order]


class Tree:
    """The topics with transforms."""

    def __init__(self) -> None:
        """Start with none."""
        self._moving, self._static = Transforms(), Transforms()
        self.topics = (Topic('pose_source', '/tf', TF, self._moving),
                       Topic('pose_source', '/tf_static', TF, self._static))

    def poses(self, path: Path, contents: Contents, config: Config) -> list[TimedPose]:
        """Return the flange poses; raises BagError, and the errors of Topic.items."""
        tracker = FlangeTracker(config.base_frame, config.robot_effector_frame)
        moving, static = self.topics
        if static.name in contents.topics:
            # first: a node that starts late publishes them after the motion
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
        """Return the ids of transforms whose stamps fit the others of the same frame."""
        of_frame: dict[str, list[tuple[int, Any]]] = {}
        for transforms in self._moving.messages:
            for t in transforms:
                of_frame.setdefault(t.child_frame_id, []).append((stamp_of(t.header), t))
        return {id(t) for child, stamped in of_frame.items()
                for t in in_their_order(f'/tf (frame {child})', stamped, contents)}
