"""Where the flange was at any time of a recording: its poses as arrays, 64 bytes each."""
from __future__ import annotations

from collections.abc import Iterable

from handeye_ros import se3
from handeye_ros.data import Array, TimedPose
from handeye_ros.sampling.errors import TimeBackwardsError
from handeye_ros.sampling.stream import in_order
import numpy as np
from numpy.typing import NDArray

NS = 1e-9


class Track:
    """The poses of a flange in the order of their stamps, to be asked between them."""

    def __init__(self, poses: Iterable[TimedPose], max_gap: float) -> None:
        """
        Take poses in any order; those whose stamps do not fit the others are left out.

        max_gap: poses further apart (s) say nothing of the time between them. Raises
        TimeBackwardsError when two runs are mixed.
        """
        rows = np.fromiter(
            ((p.stamp, (*p.translation, *p.quaternion)) for p in poses),
            np.dtype([('stamp', np.int64), ('pose', np.float64, 7)]))
        fits = in_order(rows['stamp'].tolist())
        if fits is None:
            raise TimeBackwardsError('the poses', *_first_jump_back(rows['stamp']))
        rows = rows[np.array(fits, dtype=bool)]
        _, first = np.unique(rows['stamp'], return_index=True)
        self.stamps: NDArray[np.int64] = rows['stamp'][first]
        self._poses = rows['pose'][first]
        self._max_gap = max_gap

    def at(self, stamps: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        """
        Return T_base_flange at the stamps that lie between two poses (k, 4, 4), and which (n,).

        stamps: (n,), of neighbouring times.
        """
        after = np.searchsorted(self.stamps, stamps)
        inside = (after > 0) & (after < len(self.stamps))
        inside |= np.isin(stamps, self.stamps[:1])
        after = np.clip(after, 1, max(len(self.stamps) - 1, 1))
        if len(self.stamps) < 2 or not inside.any():
            return np.empty((0, 4, 4)), np.zeros(len(stamps), dtype=bool)
        gap = (self.stamps[after] - self.stamps[after - 1]) * NS
        known = inside & (gap <= self._max_gap)
        if not known.any():
            return np.empty((0, 4, 4)), known
        part = slice(int(after[known].min()) - 1, int(after[known].max()) + 1)
        start = self.stamps[part][0]
        times, poses = (self.stamps[part] - start) * NS, self._poses[part]
        return se3.interpolated(times, poses[:, :3], poses[:, 3:],
                                (stamps[known] - start) * NS), known


def _first_jump_back(stamps: NDArray[np.int64]) -> tuple[int, float]:
    """Return the index behind the first large jump back, and by how many seconds it goes."""
    behind = (np.maximum.accumulate(stamps) - stamps) * NS
    index = int(np.argmax(behind > 1.0))
    return index, float(behind[index])
