"""The frames that drivers publish in, seen from the standard sensor frame."""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros.data import Array
from handeye_ros.simulate.stations import lift
import numpy as np


@dataclass(frozen=True, eq=False)
class Frame:
    """
    A published frame.

    T_standard_sensor: (4, 4) pose of the published frame in the standard one (x along the laser
    line, z the range, y = 0). axes: of the published frame, along the line and range.
    range_sign: -1 where the published range falls with the distance.
    """

    T_standard_sensor: Array
    axes: tuple[str, str] = ('x', 'z')
    range_sign: int = 1


def _rotation(*columns: tuple[float, float, float], x: float = 0.0, z: float = 0.0) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.array(columns).T, [x, 0.0, z]
    return T


FRAMES = {
    'standard': Frame(np.eye(4)),
    'z_up': Frame(_rotation((1, 0, 0), (0, -1, 0), (0, 0, -1), z=0.2), range_sign=-1),
    # zero in the middle of the range, which is counted upwards, and at the left of a wide field
    'off_centre': Frame(_rotation((1, 0, 0), (0, -1, 0), (0, 0, -1), x=-0.07, z=0.275),
                        range_sign=-1),
    'x_reversed': Frame(_rotation((-1, 0, 0), (0, -1, 0), (0, 0, 1))),
    'y_along_line': Frame(_rotation((0, -1, 0), (1, 0, 0), (0, 0, 1)), axes=('y', 'z')),
}


def published(frame: Frame, points: Array) -> Array:
    """Return points (..., 2) of the standard sensor plane along the axes of the published one."""
    R, t = frame.T_standard_sensor[:3, :3], frame.T_standard_sensor[:3, 3]
    in_frame = (lift(points) - t) @ R
    return np.asarray(in_frame[..., ['xyz'.index(axis) for axis in frame.axes]])
