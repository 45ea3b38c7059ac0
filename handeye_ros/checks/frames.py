"""Frames that cannot be: the sensor's is not one of the robot's."""
from __future__ import annotations

from handeye_ros.checks.errors import SensorFrameError
from handeye_ros.config import Config


def require_own_frame(frame_id: str, config: Config) -> None:
    """
    Refuse profiles in a frame of the robot: the result would be a transform to itself.

    frame_id: of the profiles. Raises SensorFrameError.
    """
    for key in ('robot_effector_frame', 'robot_base_frame'):
        if frame_id == getattr(config, key):
            raise SensorFrameError(frame_id, key)
