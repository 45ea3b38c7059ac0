# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Orientations as robot controllers show them, and back.

Each controller has its own angles, units and order of numbers; a name such as kuka-abc stands
for all of these. Sources: the programming manuals of the vendors, see docs/contract.md.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
import warnings

from handeye_ros.data import Array
from handeye_ros.errors import UnknownNameError
import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Notation:
    """
    How a controller writes a pose.

    title: in words
    labels: names of the k numbers of an orientation
    angle: their unit, deg or rad, or '' for a quaternion
    length: unit of positions
    numbers: converts a Rotation to numbers (n, k)
    rotation: converts such numbers to a Rotation
    """

    title: str
    labels: tuple[str, ...]
    angle: str
    length: str
    numbers: Callable[[Rotation], Array]
    rotation: Callable[[Array], Rotation]

    def columns(self, prefix: str) -> list[str]:
        """Return the names of the columns of an orientation in a table."""
        return [f'{prefix}_{label}' for label in self.labels]


def _euler_numbers(axes: str, rotation: Rotation) -> Array:
    with warnings.catch_warnings():  # of gimbal lock, where the angles are not unique
        warnings.simplefilter('ignore', UserWarning)
        return np.asarray(rotation.as_euler(axes, degrees=True))


def _euler(title: str, labels: tuple[str, ...], axes: str) -> Notation:
    """Return a notation by angles in degrees; axes: small as of scipy for fixed ones."""
    return Notation(title, labels, 'deg', 'mm', partial(_euler_numbers, axes),
                    partial(Rotation.from_euler, axes, degrees=True))


def _wxyz(rotation: Rotation) -> Array:
    """Return quaternions (n, 4) as w x y z with w >= 0."""
    q = rotation.as_quat()[..., [3, 0, 1, 2]]
    return np.asarray(np.where(q[..., :1] < 0, -q, q))


def _from_wxyz(numbers: Array) -> Rotation:
    return Rotation.from_quat(numbers[..., [1, 2, 3, 0]])


NOTATIONS = {
    'kuka-abc': _euler('KUKA A B C: about z, then the turned y, then the turned x',
                       ('a', 'b', 'c'), 'ZYX'),
    'fanuc-wpr': _euler('FANUC W P R: about the fixed axes x, y, z', ('w', 'p', 'r'), 'xyz'),
    'abb-quaternion': Notation('ABB q1 q2 q3 q4: a quaternion, w x y z',
                               ('q1', 'q2', 'q3', 'q4'), '', 'mm', _wxyz, _from_wxyz),
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
               partial(Rotation.as_euler, seq='xyz'), partial(Rotation.from_euler, 'xyz'))


def notation_of(name: str) -> Notation:
    """Return the notation of a name, or of a vendor alone; raises UnknownNameError."""
    full = [known for known in NOTATIONS if name in (known, known.split('-')[0])]
    if not full:
        raise UnknownNameError('notation of angles', name, list(NOTATIONS))
    return NOTATIONS[full[0]]
