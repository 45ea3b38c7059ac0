"""What may be wrong with joint values and points that contradict each other: usual mistakes."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
import math

from handeye_ros.errors import DataError
from handeye_ros.kinematics.chain import Chain, REVOLUTE
from handeye_ros.kinematics.model import Arm
from handeye_ros.kinematics.points import Points
from handeye_ros.kinematics.starts import first_fit
import numpy as np

FEW = 2  # starts: a cause is seen by any of them
BETTER = 0.2  # of the residual: what explains so much is the cause


def cause_of(data: Points, residual: float, chain: Chain) -> str:
    """Return what makes the points fit after all, in words, empty where nothing usual does."""
    best, found = BETTER * residual, ''
    for words, changed in _changes(data, chain):
        try:
            rms = first_fit(changed, Arm(chain), FEW).noise_rms
        except DataError:
            continue
        if rms < best:
            best, found = rms, words
    return found


def _changes(data: Points, chain: Chain) -> Iterator[tuple[str, Points]]:
    turning = np.array([joint.kind == REVOLUTE for joint in chain.joints])
    for factor, words in ((math.radians(1), 'degrees that are stated as radians'),
                          (math.degrees(1), 'radians that are stated as degrees')):
        yield (f'the joint values seem to be {words}',
               replace(data, q=data.q * np.where(turning, factor, 1.0)))
    for j, joint in enumerate(chain.joints):
        yield (f'{joint.name} seems to turn the other way than in the URDF',
               replace(data, q=data.q * np.where(np.arange(len(turning)) == j, -1.0, 1.0)))
    if len(chain.joints) >= 3:
        coupled = data.q.copy()
        coupled[:, 2] += coupled[:, 1]
        yield (f'{chain.joints[2].name} seems to be counted from the horizontal, as some '
               f'controllers do: add {chain.joints[1].name} to it', replace(data, q=coupled))
    other = 'eye_on_base' if data.on_flange else 'eye_in_hand'
    yield f'set calibration_type to {other}', replace(data, on_flange=not data.on_flange)
    for factor in (1e-3, 1e3):
        yield ('the unit of x, y, z seems to be wrong', replace(data, points=data.points * factor))
