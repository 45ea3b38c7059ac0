"""Why the robot's kinematics cannot be found: the URDF, the joints, the configurations."""
from __future__ import annotations

from collections.abc import Sequence
import math

from handeye_ros.errors import DataError, InputError, mm, nearest


class UrdfError(InputError):
    """A URDF, or kinematics.yaml, that cannot be read or does not describe a serial arm."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path}: {reason}')


class MissingPinocchioError(InputError):
    """A URDF is to be read without pinocchio."""

    def __init__(self) -> None:
        super().__init__('reading a URDF needs pinocchio: install the package '
                         'ros-jazzy-pinocchio, or handeye_ros[kinematics] with pip')


class JointNamesError(InputError):
    """Joint values and joints of the URDF that have different names."""

    @classmethod
    def missing(cls, source: object, joint: str, found: Sequence[str]) -> JointNamesError:
        """Return the error for a joint of the robot without values."""
        return cls(f'{source}: there are no values of the joint {joint}{nearest(joint, found)}; '
                   f'the joints with values are {", ".join(found) or "none"}; name them as the '
                   'URDF does')


class JointRangeError(DataError):
    """Joint values beyond what the joint can reach."""

    def __init__(self, joint: str, value: float, lower: float, upper: float) -> None:
        hint = ('; they seem to be degrees that are stated as radians'
                if abs(value) > 2 * math.pi else '')
        super().__init__(f'{joint} reaches {value:.4g}, and the URDF limits it to {lower:.4g} to '
                         f'{upper:.4g} (radians or metres){hint}: check the unit of the joint '
                         'values, or the limits in the URDF')


class TooFewConfigurationsError(DataError):
    """Fewer poses than the kinematics need."""

    def __init__(self, usable: int, needed: int) -> None:
        super().__init__(f'{usable} usable robot configurations; the kinematics need at least '
                         f'{needed}, and 40 are a good number: record more, with all joints '
                         'moving')


class ContradictionError(DataError):
    """Joint values, URDF and measured points that do not belong together."""

    def __init__(self, residual: float, limit: float, cause: str = '') -> None:
        super().__init__(f'joint values and measured points contradict each other by '
                         f'{mm(residual)} RMS, beyond the {mm(limit)} of a robot that is only '
                         f'inaccurate: {cause or DEFAULT_CAUSE}')


class NoJointValuesError(InputError):
    """Samples at a time of which no joint values are known."""

    def __init__(self, without: int, count: int) -> None:
        super().__init__(f'{without} of {count} samples have no joint values of their time: joint '
                         'values and profiles must be recorded together, with clocks that agree')


class TargetsApartError(DataError):
    """Several targets that see the sensor at different places."""

    def __init__(self, distance: float) -> None:
        super().__init__(f'two recordings place the sensor {mm(distance)} apart: give only '
                         'recordings of one sensor in one mount, on one robot')


DEFAULT_CAUSE = ('check that the URDF is of this robot, the unit and the sign of each joint, '
                 'calibration_type, and that the target did not move')


class OtherRobotError(DataError):
    """An axis so far from where the URDF has it that the URDF is of another robot."""

    def __init__(self, joint: str, kind: str, off: float) -> None:
        size = mm(off) if kind == 'position' else f'{math.degrees(off):.2g} degrees'
        super().__init__(f'the axis of {joint} would be {size} off the URDF, more than the error '
                         'of any real arm: the URDF is of another robot, or of a variant of it')


class NoPostureError(DataError):
    """An arm that reaches what it has seen in one posture only."""

    def __init__(self, flange: str) -> None:
        super().__init__(f'no other posture within the joint limits brings {flange} to its former '
                         'poses: move the target to another position, and record more there')


class DegenerateConfigurationsError(DataError):
    """Configurations that leave the hand-eye transform open."""

    def __init__(self, what: str) -> None:
        super().__init__(f'these configurations do not determine {what}: move all joints, and '
                         'bring the target to different points of the field of view')
