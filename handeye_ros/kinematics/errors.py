"""Why the robot's kinematics cannot be found, and which usual mistake would explain it."""
from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
import math

from handeye_ros.data import Array
from handeye_ros.errors import DataError, InputError, mm
from handeye_ros.kinematics.model import Chain, PRISMATIC, REVOLUTE
import numpy as np

# Per kind of joint, rad and m: what limits may be passed by, as they are often stated roughly, and
# by how much a joint moves at least to say anything of itself
BEYOND = {REVOLUTE: 0.35, PRISMATIC: 0.1}
STILL = {REVOLUTE: 0.02, PRISMATIC: 0.005}
BETTER = 0.2  # a change that lowers the residual to less than this share is the cause
OTHER_SIDE = {'eye_in_hand': 'eye_on_base', 'eye_on_base': 'eye_in_hand'}


class UrdfError(InputError):
    """A URDF, or kinematics.yaml, that cannot be read or does not describe a serial arm."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path}: {reason}')


class MissingPinocchioError(InputError):
    """A URDF is to be read without pinocchio."""

    def __init__(self) -> None:
        super().__init__('reading a URDF needs pinocchio: install the package '
                         'ros-jazzy-pinocchio, or handeye_ros[kinematics] with pip')


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


def judged_joints(chain: Chain, given: Mapping[str, Array]) -> list[str]:
    """
    Return a sentence for each joint that tells nothing of itself.

    Raises JointRangeError for one that goes where it cannot be.
    """
    odd = []
    for joint in chain.joints:
        value = joint.factor * given[joint.follows] + joint.shift
        low, high = float(value.min()), float(value.max())
        for end in (low, high):
            if not joint.lower - BEYOND[joint.kind] <= end <= joint.upper + BEYOND[joint.kind]:
                raise JointRangeError(joint.name, end, joint.lower, joint.upper)
        if high - low < STILL[joint.kind]:
            size = (f'{math.degrees(high - low):.2g} degrees' if joint.kind == REVOLUTE
                    else f'{(high - low) * 1e3:.2g} mm')
            odd.append(f'{joint.name} moves by {size} only: these configurations do not determine '
                       'its error')
    return odd


@dataclass(frozen=True, eq=False)
class Change:
    """
    What may be wrong, in words, and how it is put right.

    joints: (n, n) what the joint values are multiplied by; other_side: of calibration_type; unit:
    a factor on the points of the sensor.
    """

    words: str
    joints: Array
    other_side: bool = False
    unit: float = 1.0


def cause_of(chain: Chain, q: Array, on_flange: bool, refit: Callable[[Change], float]) -> str:
    """
    Return what makes joint values and measurements agree after all, empty where nothing does.

    q: (n, joints); refit: gives the residual with a change.
    """
    as_stated, *changes = _changes(chain, on_flange, float(np.median(np.abs(q).max(axis=0))))
    best, words = BETTER * refit(as_stated), ''
    for change in changes:
        try:
            rms = refit(change)
        except (DataError, np.linalg.LinAlgError):
            continue
        if rms < best:
            best, words = rms, change.words
    still = [joint.name for joint, moves in zip(chain.joints, np.ptp(q, axis=0) > 0, strict=True)
             if not moves]
    return words or (f'{still[0]} has the same value throughout: check where its values come from'
                     if still else '')


def _changes(chain: Chain, on_flange: bool, largest: float) -> Iterator[Change]:
    """Yield what may be wrong; largest: the values of half of the joints. The first is none."""
    same = np.eye(len(chain.joints))
    turning = np.array([joint.kind == REVOLUTE for joint in chain.joints])
    yield Change('', same)
    for factor, words, possible in (
            (math.radians(1), 'degrees that are stated as radians', largest > 2 * math.pi),
            (math.degrees(1), 'radians that are stated as degrees', largest < math.radians(10))):
        if possible:
            yield Change(f'the joint values seem to be {words}', np.diag(
                np.where(turning, factor, 1.0)))
    for joint, one in zip(chain.joints, same, strict=True):
        yield Change(f'{joint.name} seems to turn the other way than in the URDF',
                     np.diag(1 - 2 * one))
    if len(chain.joints) >= 3:
        coupled = same.copy()
        coupled[2, 1] = 1.0
        yield Change(
            f'{chain.joints[2].name} seems to be counted from the horizontal, as some controllers '
            f'do: add {chain.joints[1].name} to it', coupled)
    other = OTHER_SIDE['eye_in_hand' if on_flange else 'eye_on_base']
    yield Change(f'set calibration_type to {other}', same, other_side=True)
    for unit in (1e-3, 1e3):
        yield Change('the unit of what the sensor measures seems to be wrong', same, unit=unit)
