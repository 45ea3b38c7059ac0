"""
Robot configurations with the points that the sensor measured there, from a CSV or YAML table.

Columns named as the joints of the URDF with their unit (`joint_1 [degrees]`), `x [mm]`, `y [mm]`,
`z [mm]` in the sensor frame; optional: `target` names the point where there are several, and
`flange_x [mm]` ... `flange_qw` (or `flange_roll [deg]` ...) are the controller's own poses.
"""
from __future__ import annotations

from collections.abc import Mapping
import math
from pathlib import Path

from handeye_ros.data import Array
from handeye_ros.files.tables import ANGLE, LENGTH, Table
from handeye_ros.kinematics.chain import Chain, PRISMATIC
from handeye_ros.kinematics.errors import JointRangeError
from handeye_ros.kinematics.points import Points
import numpy as np

BEYOND = {ANGLE: 0.35, LENGTH: 0.1}  # what limits may be passed by: they are often stated roughly
STILL = {ANGLE: 0.02, LENGTH: 0.005}  # a joint that moves by less tells nothing of itself
ALONE = 'target'  # the name of the point of a table without that column


def read_table(path: Path, chain: Chain, on_flange: bool) -> tuple[Points, tuple[str, ...]]:
    """
    Return what a table holds, and a sentence for each thing that is odd.

    Raises TableError, JointNamesError, JointRangeError.
    """
    table = Table(path)
    kinds = {j.follows: LENGTH if j.kind == PRISMATIC else ANGLE for j in chain.joints}
    given = {name: table.values([name], kind)[:, 0] for name, kind in kinds.items()
             if table.has([name])}
    q = chain.values(given, path)
    points = table.values(['x', 'y', 'z'], LENGTH)
    labels = table.text('target') if table.has(['target']) else [ALONE] * len(points)
    names = tuple(dict.fromkeys(labels))
    pose = [f'flange_{axis}' for axis in 'xyz']
    reported = table.poses('flange') if table.has(pose) else None
    target = np.array([names.index(label) for label in labels], dtype=np.intp)
    unused = [name for name in table.names if table.kind(name) == ANGLE
              and name not in kinds and not name.startswith('flange_')]
    odd = [f'the column {name} is no joint between {chain.base} and {chain.flange}: it is not '
           'used' for name in unused]
    data = Points(q, points, target, names, np.arange(1, len(points) + 1), on_flange, reported)
    return data, (*odd, *judged_joints(chain, given))


def judged_joints(chain: Chain, given: Mapping[str, Array]) -> list[str]:
    """
    Return a sentence for each joint that tells nothing of itself.

    Raises JointRangeError for one that goes where it cannot be.
    """
    odd = []
    for joint in chain.joints:
        kind = LENGTH if joint.kind == PRISMATIC else ANGLE
        value = joint.factor * given[joint.follows] + joint.shift
        low, high = float(value.min()), float(value.max())
        for end in (low, high):
            if not joint.lower - BEYOND[kind] <= end <= joint.upper + BEYOND[kind]:
                raise JointRangeError(joint.name, end, joint.lower, joint.upper)
        if high - low < STILL[kind]:
            size = (f'{math.degrees(high - low):.2g} degrees' if kind == ANGLE
                    else f'{(high - low) * 1e3:.2g} mm')
            odd.append(f'{joint.name} moves by {size} only: its own error cannot be known from '
                       'these configurations')
    return odd
