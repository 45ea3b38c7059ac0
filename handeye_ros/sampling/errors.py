"""Why a stop gives no sample, or a recording no stops."""
from __future__ import annotations

from handeye_ros.errors import DataError, InputError
from handeye_ros.sampling.dwells import Motion


class BaseFrameError(InputError):
    """Poses in another frame than the configured robot_base_frame."""

    def __init__(self, frame: str, wanted: str) -> None:
        super().__init__(f'the poses are given in "{frame}", but robot_base_frame is "{wanted}": '
                         f'set it to {frame}, or leave it out; it is then that of the poses')


class NoPosesError(DataError):
    """No pose of the flange was received; topic: None if they come from transforms."""

    def __init__(self, topic: str | None) -> None:
        super().__init__(
            'no flange pose was received from /tf: start the robot driver, or set '
            'robot_base_frame and robot_effector_frame' if topic is None else
            f'no flange pose was received on {topic}: start the robot driver, or set pose_topic')


class MovingError(DataError):
    """A sample was requested while the robot moved, or too soon after it stopped."""

    def __init__(self, still_time: float, motion: Motion | None) -> None:
        if motion is None:
            how = 'too few poses have come to measure its motion'
        else:
            how = motion.sentence
        super().__init__(f'the robot has not stood still for {still_time:g} s, {how}: stop it, '
                         'wait, and take the sample again')


class SilentPosesError(DataError):
    """A sample was requested while no poses arrived."""

    def __init__(self, seconds: float) -> None:
        super().__init__(f'no pose has come for {seconds:.1f} s, so the robot position is not '
                         'known: check the robot driver, and take the sample again')


class LatePosesError(DataError):
    """A sample was requested while the poses had stamps of another time."""

    def __init__(self) -> None:
        super().__init__('the poses come with older stamps than those before, so the robot '
                         'position is not known: if the clock was set, wait a second and take '
                         'the sample again; otherwise let only one node publish poses')


class NothingNewError(DataError):
    """A sample was requested at a pose that has one already; reason: which one."""

    def __init__(self, reason: str) -> None:
        super().__init__(f'{reason}: move on, and turn the tool')


class FlatCrossingError(DataError):
    """A sample where the laser crosses the edge at too small an angle; reason: the angle."""

    def __init__(self, reason: str) -> None:
        super().__init__(f'{reason}, and take the sample again')


class NoProfilesError(DataError):
    """No profile came while the robot stood still."""

    def __init__(self, duration: float) -> None:
        super().__init__(f'no profile has a stamp of the {duration:.1f} s during which the robot '
                         'stood still here: either the sensor sent none, or its clock is not '
                         'that of the robot')


class NothingToRemoveError(DataError):
    """There is no sample to remove."""

    def __init__(self) -> None:
        super().__init__('there is no sample to remove')


class NotAskedError(DataError):
    """No sample was requested; reason: how often it would have been possible."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)


class NoStationsError(DataError):
    """The robot never stood still."""

    def __init__(self, poses: int, still_time: float, longest: float) -> None:
        super().__init__(f'the robot never stood still for {still_time:g} s in {poses} poses, '
                         f'but for {longest:.2g} s at most: stop at each sample, or lower '
                         'sampling.still_time; if its poses are noisy, raise '
                         'sampling.still_translation and sampling.still_rotation; if the robot '
                         'moves all the time, set sampling.mode to moving')


class SparsePosesError(DataError):
    """Poses too far apart to tell when the robot stood still."""

    def __init__(self, period: float, limit: float) -> None:
        super().__init__(f'the flange poses come only every {period:.2g} s, more than '
                         f'sampling.max_pose_gap ({limit:g} s): publish them more often, also '
                         'while the robot stands still, or raise sampling.max_pose_gap')


class PositionUnitError(DataError):
    """Positions too large for metres."""

    def __init__(self, largest: float) -> None:
        super().__init__(f'the flange positions reach {largest:.0f} m: they seem to be in mm; '
                         'publish them in metres')


class ClocksDifferError(DataError):
    """
    Samples that fit the poses of another time.

    late: delay of the profiles (s); offset: the configured time_offset (s).
    """

    def __init__(self, late: float, offset: float) -> None:
        by = f'{abs(late):.1f} s {"late" if late > 0 else "early"}'
        super().__init__(f'the samples do not fit the poses of their time, but as if the profiles '
                         f'were {by}: the clocks of sensor and robot differ; set time_offset to '
                         f'{offset - late:.1f} (it is {offset:g}), or give both the same clock')


class ClearedError(DataError):
    """The samples were cleared while they were solved."""

    def __init__(self) -> None:
        super().__init__('the samples were cleared while the calibration was computed, so there '
                         'is no answer: take new samples')
