# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Orientations as robot controllers show them.

Each controller has its own angles, units and order of numbers; a name such as kuka-abc stands for
all of these. Sources: the programming manuals of the vendors, see docs/contract.md.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import UnknownNameError
import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Notation:
    """
    How a controller writes a pose.

    title: the notation in words
    labels: names of the k numbers of an orientation
    angle_unit: unit of these numbers, deg or rad, or '' for a quaternion
    length_unit: unit of positions, mm or m
    to_numbers: converts a Rotation to numbers (n, k)
    to_rotation: converts such numbers to a Rotation
    """

    title: str
    labels: tuple[str, ...]
    angle_unit: str
    length_unit: str
    to_numbers: Callable[[Rotation], Array]
    to_rotation: Callable[[Array], Rotation]

    def columns(self, prefix: str) -> list[str]:
        """Return the names of the columns of an orientation in a table."""
        return [f'{prefix}_{label}' for label in self.labels]


def _euler(title: str, labels: tuple[str, ...], axes: str) -> Notation:
    """Return a notation by three angles in degrees; axes: as scipy, lower case for fixed ones."""
    return Notation(title, labels, 'deg', 'mm',
                    lambda rotation: np.degrees(se3.euler_angles(rotation, axes)),
                    partial(Rotation.from_euler, axes, degrees=True))


NOTATIONS = {
    'kuka-abc': _euler('KUKA A B C: about z, then the turned y, then the turned x',
                       ('a', 'b', 'c'), 'ZYX'),
    'fanuc-wpr': _euler('FANUC W P R: about the fixed axes x, y, z', ('w', 'p', 'r'), 'xyz'),
    'abb-quaternion': Notation('ABB q1 q2 q3 q4: a quaternion, w x y z',
                               ('q1', 'q2', 'q3', 'q4'), '', 'mm',
                               lambda turn: turn.as_quat(canonical=True)[..., [3, 0, 1, 2]],
                               lambda numbers: Rotation.from_quat(numbers[..., [1, 2, 3, 0]])),
    'ur-rotation-vector': Notation('Universal Robots RX RY RZ: a rotation vector',
                                   ('rx', 'ry', 'rz'), 'rad', 'm', Rotation.as_rotvec,
                                   Rotation.from_rotvec),
    'staubli-rxryrz': _euler('Staubli Rx Ry Rz: about x, then the turned y, then the turned z',
                             ('rx', 'ry', 'rz'), 'XYZ'),
    'yaskawa-rxryrz': _euler('Yaskawa Rx Ry Rz: about the fixed axes x, y, z',
                             ('rx', 'ry', 'rz'), 'xyz'),
}


# of tables that name no controller
QUATERNION = Notation('x y z w', ('qx', 'qy', 'qz', 'qw'), '', 'm', Rotation.as_quat,
                      Rotation.from_quat)
RPY = Notation('roll, pitch, yaw of URDF', ('roll', 'pitch', 'yaw'), 'rad', 'm',
               partial(se3.euler_angles, axes='xyz'), partial(Rotation.from_euler, 'xyz'))


def notation_of(name: str) -> Notation:
    """Return the notation of a name, or of a vendor alone; raises UnknownNameError."""
    for full_name, notation in NOTATIONS.items():
        if name in (full_name, full_name.split('-')[0]):
            return notation
    raise UnknownNameError('notation of angles', name, list(NOTATIONS))
