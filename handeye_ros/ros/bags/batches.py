"""
Several profiles in one message: which row was taken when.

With a period the stamps of the rows are known. Without one it is only known that they were taken
about the stamp, within the time from one message to the next: such a profile counts where the
robot stood still during all of it.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from handeye_ros.config import ProfileConfig
from handeye_ros.data import Array, RawProfile
from handeye_ros.ros.bags import cdr
from handeye_ros.ros.bags.messages import view_of
import numpy as np

SHARED = 0.5  # of the line that rows share which are profiles
FEWEST_COLUMNS = 10  # of a row that can be told to be a profile

# the share of the time of a message that lies before its stamp
BEFORE = {'first': 0.0, 'middle': 0.5, 'last': 1.0}


def rows_of(msg: Any, config: ProfileConfig) -> int:
    """
    Return how many profiles the rows of a sensor_msgs/PointCloud2 are, 1 where they are points.

    Rows that run along the same part of the line are profiles. Raises MessageError.

    """
    height, width = int(msg.height), int(msg.width)
    if config.rows == 'points' or height * width == 0 or height == 1:
        return 1
    if config.rows == 'profiles':
        return height
    if width < FEWEST_COLUMNS:
        return 1
    along = view_of(msg, config.axes[0][-1])
    first, last = (_span(along[index].astype(np.float64)) for index in (0, -1))
    shared = min(first[1], last[1]) - max(first[0], last[0])
    longer = max(first[1] - first[0], last[1] - last[0])
    return height if shared > SHARED * longer else 1


def _span(values: Array) -> tuple[float, float]:
    """Return the smallest and the largest of the values that are finite, NaN without any."""
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if len(finite) else (np.nan, np.nan)


def split(raw: RawProfile, before: int | None, config: ProfileConfig) -> list[RawProfile]:
    """
    Return the profiles of a message, in the order of their stamps.

    before: the stamp of the message before, None for the first; where there is no period the
    first message is left out, as nobody knows how long it took.
    """
    if raw.rows == 1:
        return [raw]
    share, reach = BEFORE[config.stamp], (0, 0)
    if config.period:
        step = config.period * 1e9
    elif before is None or before >= raw.stamp:
        return []
    else:  # their order is told by single nanoseconds
        step, took = 1.0, raw.stamp - before
        reach = (round(share * took), round((1.0 - share) * took))
    first = raw.stamp - round(share * (raw.rows - 1) * step)
    stamps = [first + round(index * step) for index in range(raw.rows)]
    return [replace(raw, stamp=stamp, fetch=partial(_row, raw.fetch, index, stamp), rows=1,
                    held=raw.held // raw.rows, reach=reach)
            for index, stamp in enumerate(stamps)]


def _row(fetch: Callable[[], bytes], index: int, stamp: int) -> bytes:
    return cdr.row(fetch(), index, stamp)
