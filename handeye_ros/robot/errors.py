"""Refusals of kinematic calibration, and common errors that explain contradictions."""
from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
import math

from handeye_ros.data import Array
from handeye_ros.errors import DataError, InputError, mm
from handeye_ros.robot.model import Chain, PRISMATIC, REVOLUTE
import numpy as np

# Per kind of joint, rad and m: tolerance of the limits, which are often stated roughly, and the
# smallest range of values that determines the error of a joint.
BEYOND = {REVOLUTE: 0.35, PRISMATIC: 0.1}
STILL = {REVOLUTE: 0.02, PRISMATIC: 0.005}
BETTER = 0.2  # a change that reduces the residual to less than this fraction is the cause
OTHER_SIDE = {'eye_in_hand': 'eye_on_base', 'eye_on_base': 'eye_in_hand'}


class UrdfError(InputError):
    """A URDF, or kinematics.yaml, that cannot be read or does not describe a serial arm."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path}: {reason}')


class MissingPinocchioError(InputError):
    """Reading a URDF needs pinocchio, which is not installed."""

    def __init__(self) -> None:
        super().__init__('reading a URDF needs pinocchio: install the package '
                         'ros-jazzy-pinocchio, or handeye_ros[kinematics] with pip')


class JointRangeError(DataError):
    """Joint values beyond the range of a joint."""

    def __init__(self, joint: str, value: float, lower: float, upper: float) -> None:
        hint = ('; they seem to be degrees stated as radians'
                if abs(value) > 2 * math.pi else '')
        super().__init__(f'{joint} reaches {value:.4g}, and the URDF limits it to {lower:.4g} to '
                         f'{upper:.4g} (radians or metres){hint}: check the unit of the joint '
                         'values, or the limits in the URDF')


class TooFewConfigurationsError(DataError):
    """Fewer configurations than the kinematics need."""

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
    """Samples at times without joint values."""

    def __init__(self, without: int, count: int) -> None:
        super().__init__(f'{without} of {count} samples have no joint values of their time: joint '
                         'values and profiles must be recorded together, with clocks that agree')


class TargetsApartError(DataError):
    """Several targets whose calibrations differ."""

    def __init__(self, distance: float) -> None:
        super().__init__(f'two recordings place the sensor {mm(distance)} apart: give only '
                         'recordings of one sensor in one mount, on one robot')


DEFAULT_CAUSE = ('check that the URDF is of this robot, the unit and the sign of each joint, '
                 'calibration_type, and that the target did not move')


class OtherRobotError(DataError):
    """An axis too far from that of the URDF: it is the URDF of another robot."""

    def __init__(self, joint: str, kind: str, error: float) -> None:
        size = mm(error) if kind == 'position' else f'{math.degrees(error):.2g} degrees'
        super().__init__(f'the axis of {joint} would be {size} off the URDF, more than the error '
                         'of any real arm: the URDF is of another robot, or of a variant of it')


class DegenerateConfigurationsError(DataError):
    """Configurations that do not determine the hand-eye transform."""

    def __init__(self, quantity: str) -> None:
        super().__init__(f'these configurations do not determine {quantity}: move all joints, and '
                         'bring the target to different points of the field of view')


def joint_notes(chain: Chain, readings: Mapping[str, Array]) -> list[str]:
    """
    Return a sentence for each joint whose error is not determined.

    Raises JointRangeError for values beyond the limits of a joint.
    """
    sentences = []
    for joint in chain.joints:
        value = joint.factor * readings[joint.follows] + joint.shift
        low, high = float(value.min()), float(value.max())
        for end in (low, high):
            if not joint.lower - BEYOND[joint.kind] <= end <= joint.upper + BEYOND[joint.kind]:
                raise JointRangeError(joint.name, end, joint.lower, joint.upper)
        if high - low < STILL[joint.kind]:
            size = (f'{math.degrees(high - low):.2g} degrees' if joint.kind == REVOLUTE
                    else f'{(high - low) * 1e3:.2g} mm')
            sentences.append(f'{joint.name} moves by {size} only: these configurations do not '
                             'determine its error')
    return sentences


@dataclass(frozen=True, eq=False)
class Change:
    """
    A possible error, in words, and its correction.

    joints: (n, n) matrix that corrects the joint values; other_side: the other calibration_type;
    unit: a factor on the points of the sensor.
    """

    words: str
    joints: Array
    other_side: bool = False
    unit: float = 1.0


def cause_of(chain: Chain, q: Array, on_flange: bool, refit: Callable[[Change], float]) -> str:
    """
    Return the error that explains joint values and measurements, '' if none does.

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
    constant = [joint.name for joint, extent in zip(chain.joints, np.ptp(q, axis=0), strict=True)
                if extent == 0]
    if words or not constant:
        return words
    return f'{constant[0]} has the same value throughout: check where its values come from'


def _changes(chain: Chain, on_flange: bool, largest: float) -> Iterator[Change]:
    """Yield no change, then possible errors; largest: median of the joints' largest values."""
    identity = np.eye(len(chain.joints))
    revolute = np.array([joint.kind == REVOLUTE for joint in chain.joints])
    yield Change('', identity)
    for factor, words, possible in (
            (math.radians(1), 'degrees stated as radians', largest > 2 * math.pi),
            (math.degrees(1), 'radians stated as degrees', largest < math.radians(10))):
        if possible:
            yield Change(f'the joint values seem to be {words}', np.diag(
                np.where(revolute, factor, 1.0)))
    for joint, column in zip(chain.joints, identity, strict=True):
        yield Change(f'{joint.name} seems to turn the other way than in the URDF',
                     np.diag(1 - 2 * column))
    if len(chain.joints) >= 3:
        coupled = identity.copy()
        coupled[2, 1] = 1.0
        yield Change(
            f'{chain.joints[2].name} seems to be counted from the horizontal, as some controllers '
            f'do: add {chain.joints[1].name} to it', coupled)
    other = OTHER_SIDE['eye_in_hand' if on_flange else 'eye_on_base']
    yield Change(f'set calibration_type to {other}', identity, other_side=True)
    for unit in (1e-3, 1e3):
        yield Change('the unit of what the sensor measures seems to be wrong', identity, unit=unit)
