# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What contradicts an arm: values beyond its joints, and errors that explain measurements."""
from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
import math

from handeye_ros.data import Array
from handeye_ros.errors import DataError, mm
from handeye_ros.robot.model import Chain, PRISMATIC, REVOLUTE
import numpy as np

# Per kind of joint, rad and m: tolerance of the limits, which are often stated roughly, and the
# smallest range of values that determines the error of a joint.
BEYOND = {REVOLUTE: 0.35, PRISMATIC: 0.1}
STILL = {REVOLUTE: 0.02, PRISMATIC: 0.005}
BETTER = 0.2  # a change that reduces the residual to less than this fraction is the cause
OTHER_SIDE = {'eye_in_hand': 'eye_on_base', 'eye_on_base': 'eye_in_hand'}


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


DEFAULT_CAUSE = ('check that the URDF is of this robot, the unit and the sign of each joint, '
                 'calibration_type, and that the target did not move')


def joint_notes(chain: Chain, readings: Mapping[str, Array]) -> list[str]:
    """
    Return a sentence for each joint whose error is not determined.

    Raises DataError for values beyond the limits of a joint.
    """
    sentences = []
    for joint in chain.joints:
        value = joint.factor * readings[joint.follows] + joint.shift
        low, high = float(value.min()), float(value.max())
        for end in (low, high):
            if not joint.lower - BEYOND[joint.kind] <= end <= joint.upper + BEYOND[joint.kind]:
                hint = ('; they seem to be degrees stated as radians'
                        if abs(end) > 2 * math.pi else '')
                raise DataError(
                    f'{joint.name} reaches {end:.4g}, and the URDF limits it to '
                    f'{joint.lower:.4g} to {joint.upper:.4g} (radians or metres){hint}: check the '
                    'unit of the joint values, or the limits in the URDF')
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
