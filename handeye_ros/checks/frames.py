"""The frame of the profiles: what is refused of it, and what a user should know."""
from __future__ import annotations

from collections.abc import Iterator

from handeye_ros.checks.errors import SensorFrameError
from handeye_ros.config import Config, UNNAMED_FRAME

LARGEST_BESIDE = 1e-3  # m; of profiles beside their plane that need no note


def require_own_frame(frame_id: str, config: Config) -> None:
    """
    Refuse profiles in a frame of the robot: the result would be a transform to itself.

    frame_id: of the profiles. Raises SensorFrameError.
    """
    for key, robots in (('robot_effector_frame', config.robot_effector_frame),
                        ('robot_base_frame', config.base_frame)):
        if frame_id == robots:
            raise SensorFrameError(frame_id, key)


def frame_notes(frame: str | None, beside: float, config: Config) -> Iterator[str]:
    """
    Yield what does not fit, one sentence each.

    frame: of the profiles, None before the first; beside: how far they lie beside their plane
    (metres).
    """
    if frame == '':
        yield f'the profiles have no frame_id: the result calls their frame "{UNNAMED_FRAME}"'
    if beside > LARGEST_BESIDE:
        yield (f'the profiles lie up to {beside * 1e3:.1f} mm beside the plane of '
               f'{" and ".join(config.profile.axes)} in their frame: that coordinate is not '
               'used, and the result holds for points in the plane')
