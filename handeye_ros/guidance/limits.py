"""Where a proposed pose may be, seen from the first sample's."""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Limits:
    """
    What guidance.* allows around the first sample.

    first: (4, 4) pose of what carries the sensor in what carries the target; in_hand: whether
    that is the flange in the base, and not the base in the flange. reach: metres; tilt (of the
    viewing direction), turn (about it): radians.
    """

    first: Array
    in_hand: bool
    reach: float
    tilt: float
    turn: float

    def allow(self, poses: Array, X: Array) -> NDArray[np.bool_]:
        """Return which poses (n, 4, 4) like first are allowed to a sensor at X (4, 4)."""
        T, first = (poses, self.first) if self.in_hand else (
            se3.inverse(poses), se3.inverse(self.first))
        away = np.linalg.norm(T[:, :3, 3] - first[:3, 3], axis=1)
        first_sensor, sensors = self.first[:3, :3] @ X[:3, :3], poses[:, :3, :3] @ X[:3, :3]
        tilted = np.arccos(np.clip(sensors[:, :, 2] @ first_sensor[:, 2], -1.0, 1.0))
        twisted = np.abs(twist_of(first_sensor, sensors))
        return np.asarray((away <= self.reach) & (tilted <= self.tilt) & (twisted <= self.turn))


def twist_of(first: Array, R: Array) -> Array:
    """
    Return by how much (n,) rad sensors R (n, 3, 3) are turned about the viewing direction.

    The rotation from the first (3, 3) is one about the viewing direction, then a tilt.
    """
    relative = first.T @ R
    # of the quaternion only z and w, up to a factor
    z = relative[:, 1, 0] - relative[:, 0, 1]
    w = 1 + relative[:, 0, 0] + relative[:, 1, 1] + relative[:, 2, 2]
    return np.asarray(2 * np.arctan2(z, w))


def limits_of(first: Array, config: Config) -> Limits:
    """Return the limits of a configuration around the first sample's pose (4, 4), mounted."""
    keys = config.guidance
    return Limits(first, config.calibration_type == 'eye_in_hand', keys.reach, keys.tilt,
                  keys.turn)
