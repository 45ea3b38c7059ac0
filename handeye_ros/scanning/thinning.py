"""One point of each cube of space, at constant memory."""
from __future__ import annotations

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray

BITS = 22  # 4 million cubes are remembered, in 32 MB
MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)  # of Fibonacci hashing
HALF = 1 << 20  # cubes to either side of the origin along each axis


class Thinning:
    """
    Remembers cubes that held a point already.

    A table of fixed size: where a cloud has more cubes than it, a cube may be forgotten for
    another, and then keeps a second point when the laser comes by again.
    """

    def __init__(self, edge: float) -> None:
        """Start with all cubes empty; edge: of a cube (m)."""
        self._edge = edge
        self._table = np.full(1 << BITS, np.iinfo(np.uint64).max, dtype=np.uint64)

    def new(self, points: Array) -> NDArray[np.bool_]:
        """Tell which points (3, n) are the first of their cube."""
        cells = np.floor(points / self._edge).astype(np.int64) + HALF
        x, y, z = (cells & (2 * HALF - 1)).astype(np.uint64)
        key = (x << np.uint64(42)) | (y << np.uint64(21)) | z
        slot = (key * MULTIPLIER) >> np.uint64(64 - BITS)
        is_new = np.zeros(len(key), dtype=bool)
        first = np.unique(key, return_index=True)[1]
        is_new[first] = self._table[slot[first]] != key[first]
        self._table[slot[is_new]] = key[is_new]
        return is_new
