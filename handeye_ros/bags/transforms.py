# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Flange poses from the transform tree.

tf2_ros looks up one transform at one time; this module gives every change of the flange as a pose
at its own stamp. Links with other stamps are interpolated to it, never extrapolated. Imports no
ROS.
"""
from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Mapping, Sequence

from handeye_ros import se3
from handeye_ros.data import Array, NS, TimedPose
from handeye_ros.sampling.interpolation import interpolate
from handeye_ros.sampling.stream import by_stamp, Stream
import numpy as np

STILL = 1e-5  # m, rad: a link that moves less between two transforms stands
KEPT_TRANSFORMS = 1000  # transforms of a link: 10 s of a robot driver at 100 Hz


class _Link:
    """The transforms of one frame in its parent, in the order of their stamps."""

    def __init__(self, parent: str, static: bool) -> None:
        self.parent = parent
        self.static = static
        self.poses: deque[TimedPose] = deque(maxlen=1 if static else KEPT_TRANSFORMS)
        self.stream: Stream[TimedPose] = Stream('transform')

    def at(self, stamp: int, max_gap: float) -> Array | None:
        """
        Return T_parent_child (4, 4) at a stamp; None if it is not known yet.

        It is NaN at a stamp before all transforms, and where the link moved between two of them
        that are more than max_gap (s) apart.
        """
        poses = self.poses
        if self.static:
            return se3.of_pose(poses[0])
        if not poses or stamp > poses[-1].stamp:
            return None
        index = bisect_left(poses, stamp, key=by_stamp)
        if poses[index].stamp == stamp:
            return se3.of_pose(poses[index])
        before, after = poses[index - 1], poses[index]
        if index == 0 or after.stamp - before.stamp > max_gap * NS and np.abs(
                se3.of_pose(after) - se3.of_pose(before)).max() > STILL:
            return np.full((4, 4), np.nan)
        return interpolate([before, after], [stamp])[0]


class FlangeFollower:
    """
    Computes flange poses in the base from transforms.

    Their times are those of one moving link: the nearest to the flange that is published at least
    half as often as the most frequent one.
    """

    def __init__(self, base: str, flange: str, max_gap: float) -> None:
        """
        Start with an empty tree.

        base, flange: the ids of the two frames
        max_gap: the largest time between two transforms of a moving link that are interpolated (s)
        """
        self._max_gap, self._sparse_count = max_gap, 0
        self._base = base.removeprefix('/')
        self._flange = flange.removeprefix('/')
        self._links: dict[str, _Link] = {}
        self._sent_until = -1

    @property
    def warnings(self) -> list[str]:
        """Return one sentence for each frame and reason for which transforms were dropped."""
        sparse = [f'{self._sparse_count} poses of /tf were dropped: another link moved, and its '
                  f'transforms are more than {self._max_gap:g} s apart (sampling.max_pose_gap)'
                  ] if self._sparse_count else []
        return [*sparse, *(f'/tf (frame {child}): {warning}' for child, link in self._links.items()
                           for warning in link.stream.warnings)]

    def add(self, transforms: Sequence[tuple[str, TimedPose]], static: bool) -> list[TimedPose]:
        """
        Add the transforms of one message; return the poses T_base_flange that are now known.

        transforms: child frames and their poses, as messages.transforms_from_cdr returns them
        static: whether they come from /tf_static
        """
        for child, pose in transforms:
            link = self._links.get(child)
            if link is None or (link.parent, link.static) != (pose.parent_frame, static):
                link = self._links[child] = _Link(pose.parent_frame, static)
            link.poses.extend([pose] if static else link.stream.add(pose, pose.parent_frame))
            if link.stream.step_back:
                self.restart()
        chains = self._chains()
        moving = [link for chain in chains or () for link in chain if not link.static]
        if not chains or not moving:
            return []
        most = max(link.stream.count for link in moving)
        timing_link = next(link for link in moving if 2 * link.stream.count >= most)
        poses = []
        for stamp in [p.stamp for p in timing_link.poses if p.stamp > self._sent_until]:
            T_ancestor_flange, T_ancestor_base = (
                _product(chain, stamp, self._max_gap) for chain in chains)
            if T_ancestor_flange is None or T_ancestor_base is None:
                break
            self._sent_until = stamp
            T_base_flange = se3.inverse(T_ancestor_base) @ T_ancestor_flange
            if np.isnan(T_base_flange).any():
                self._sparse_count += 1
            else:
                poses.append(TimedPose(stamp, T_base_flange[:3, 3],
                                       se3.quaternion(T_base_flange), self._base))
        return poses

    def restart(self) -> None:
        """Forget moving transforms, so that times may start again; static ones stay."""
        # copied, as another thread may add transforms meanwhile
        self._links = {child: link for child, link in self._links.copy().items() if link.static}
        self._sent_until = -1

    def missing_reason(self) -> str:
        """Return why there are no poses of the flange, '' if there are some."""
        chains, links = self._chains(), self._links.copy()
        if chains is None:
            frames = sorted({*links, *(link.parent for link in links.values())})
            return (f'no chain of transforms leads from "{self._base}" to "{self._flange}"; '
                    f'frames received: {", ".join(frames) or "none"}')
        if all(link.static for chain in chains for link in chain):
            return f'all transforms between "{self._base}" and "{self._flange}" are static'
        return ''

    def _chains(self) -> tuple[list[_Link], list[_Link]] | None:
        """Return the links from flange and base up to their common ancestor, None without one."""
        links = self._links  # which another thread may replace
        of_flange, of_base = (_ancestors(frame, links) for frame in (self._flange, self._base))
        common = next((frame for frame in of_flange if frame in of_base), None)
        if common is None:
            return None
        to_flange, to_base = ([links[frame] for frame in frames[:frames.index(common)]]
                              for frames in (of_flange, of_base))
        return to_flange, to_base


def _ancestors(frame: str, links: Mapping[str, _Link]) -> list[str]:
    """Return a frame and its ancestors, from child to parent; a loop ends them."""
    frames = [frame]
    while frames[-1] in links and links[frames[-1]].parent not in frames:
        frames.append(links[frames[-1]].parent)
    return frames


def _product(chain: list[_Link], stamp: int, max_gap: float) -> Array | None:
    """Return the pose (4, 4) of the chain's first frame in its last parent; None if unknown."""
    product = np.eye(4)
    for link in chain:
        T_parent_child = link.at(stamp, max_gap)
        if T_parent_child is None:
            return None
        product = T_parent_child @ product
    return product
