"""The line of a face, and the normal points that stand for its shape."""
from __future__ import annotations

from handeye_ros.data import Array, FaceLine
from handeye_ros.profiles.segment import Segment
import numpy as np

NORMAL_POINTS = 6


def face_line(segment: Segment, points: Array) -> FaceLine:
    """Return the face line of a segment of a profile (n, 2), with its normal points."""
    measured = points[segment.rows]
    x = measured[:, 0]
    length = np.hypot(1.0, segment.slope)
    centre = np.array([x.mean(), segment.height(x.mean())])
    std = float(segment.noise / length)
    first = np.linspace(0, len(x), min(NORMAL_POINTS, len(x)), endpoint=False).astype(int)
    count = np.diff(np.append(first, len(x)))
    means = np.add.reduceat(measured, first) / count[:, None]
    return FaceLine(centre, np.array([1.0, segment.slope]) / length, float(x.std() * length),
                    std / len(x) ** 0.5, means, std / np.sqrt(count))
