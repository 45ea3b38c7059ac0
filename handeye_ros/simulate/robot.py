# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The robot: a six-axis arm, and what is wrong with the poses that a controller reports.

The arm of assets/arm.urdf has a spherical wrist: T_base_flange = Rz(q1) Tz(D1) Ry(q2) Tz(A2)
Ry(q3) Tz(D4) Rz(q4) Ry(q5) Rz(q6) Tz(D6). Its errors are unknown to its controller.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
import re

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.simulate.scenario import RobotModel
import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

URDF = Path(__file__).with_name('assets').joinpath('arm.urdf').read_text(encoding='utf-8')
"""The text of the nominal arm's URDF."""
JOINT_AXES = 'zyyzyz'
# m along z: the places of the joints, each in the link before it, and of the flange
_, *LINK_LENGTHS = map(float, re.findall('<origin xyz="0 0 (.+)"/>', URDF))
D1, A2, D4, _, _, D6 = LINK_LENGTHS  # shoulder, upper arm, forearm, flange


@dataclass(frozen=True, eq=False)
class ArmErrors:
    """
    Errors of joints and links, unknown to the controller.

    links: (6, 6) perturbation (m, rad) after each joint and its link
    offsets: (6,) of the joints (rad)
    eccentricity, phases: (6,) amplitude (rad) and phase of an error that is periodic in the joint
        angle
    """

    links: Array
    offsets: Array
    eccentricity: Array
    phases: Array

    @property
    def flange(self) -> Array:
        """
        Return T_corrected_flange (4, 4): the flange in that of the corrected arm.

        An error behind the last axis, or along it before, is the same for all joint values: on a
        corrected arm it is part of the sensor's mount.
        """
        along_axis = np.array([0.0, 0.0, self.links[4, 2], 0.0, 0.0, 0.0])
        return np.asarray(se3.perturb(np.eye(4), along_axis)
                          @ se3.perturb(np.eye(4), self.links[5]))


def draw_arm(sigma: float, rng: Generator) -> ArmErrors:
    """Return errors with 1 sigma of each length (m) and of each angle (sigma over 1 m)."""
    links = rng.normal(size=(6, 6)) * sigma
    offsets, eccentricity = rng.normal(size=(2, 6)) * sigma
    return ArmErrors(links, offsets, eccentricity, rng.uniform(0, 2 * np.pi, 6))


def forward(joints: Array, errors: ArmErrors | None = None) -> Array:
    """Return T_base_flange (n, 4, 4) of joint angles (n, 6) (rad); errors: those of the arm."""
    T = np.tile(np.eye(4), (len(joints), 1, 1))
    for k, (axis, length) in enumerate(zip(JOINT_AXES, LINK_LENGTHS, strict=True)):
        angle = joints[:, k]
        if errors:
            angle = angle + errors.offsets[k] + errors.eccentricity[k] * np.sin(
                angle + errors.phases[k])
        R = Rotation.from_euler(axis, angle[:, None]).as_matrix()
        T = T @ se3.transform(R, R @ [0.0, 0.0, length])
        if errors:
            T = T @ se3.perturb(np.eye(4), errors.links[k])
    return T


def inverse(T: Array) -> Array:
    """
    Return the joint angles (n, 6) (rad), elbow up, of flange poses (n, 4, 4) of the nominal arm.

    Raises ValueError for a pose out of reach.
    """
    wrist = T[:, :3, 3] - D6 * T[:, :3, 2]
    q1 = np.arctan2(wrist[:, 1], wrist[:, 0])
    reach, rise = np.hypot(wrist[:, 0], wrist[:, 1]), wrist[:, 2] - D1
    distance = np.hypot(reach, rise)
    if (distance > A2 + D4).any():
        raise ValueError('a stop is out of reach of the arm')
    elevation = np.arctan2(rise, reach)
    at_shoulder = np.arccos((A2**2 + distance**2 - D4**2) / (2 * A2 * distance))
    at_wrist = np.arccos((D4**2 + distance**2 - A2**2) / (2 * D4 * distance))
    q2 = np.pi / 2 - elevation - at_shoulder
    q3 = at_shoulder + at_wrist
    R = Rotation.from_euler('ZY', np.column_stack([q1, q2 + q3])).inv() * Rotation.from_matrix(
        T[:, :3, :3])
    return np.column_stack([q1, q2, q3, R.as_euler('ZYZ')])


def arm_pose_error(T: Array, errors: ArmErrors) -> Array:
    """Return the errors (n, 6) (m, rad) of the poses that such an arm reports at T (n, 4, 4)."""
    joints = inverse(T)
    return se3.difference(forward(joints), forward(joints, errors))


def pose_error(robot: RobotModel, T: Array, rng: Generator) -> Array:
    """
    Return errors (n, 6) (m, rad) of the reported poses at T (n, 4, 4), random and smooth.

    The smooth part is six sinusoids over position (0.3 m) and orientation (0.5 rad).
    """
    random = rng.normal(size=(len(T), 6)) * np.repeat(robot.repeatability, 3)
    mean = se3.mean_pose(T)
    turned = se3.log_rotation(T[:, :3, :3] @ mean[:3, :3].T)
    scaled = np.concatenate([T[:, :3, 3] / 0.3, turned / 0.5], axis=1)
    wave, phase = rng.normal(size=(6, 6)) / np.sqrt(2), rng.uniform(0, 2 * np.pi, 6)
    amplitude = np.repeat(robot.systematic, 3) * np.sqrt(2 / 3)  # RMS of the vector of three
    return np.asarray(random + amplitude * np.sin(scaled @ wave.T + phase))


def bumped(T: Array, count: int, rng: Generator) -> Array:
    """Return the poses (n, 4, 4), count of them with errors of 1-3 mm and 0.1-0.3 degrees."""
    error = np.zeros((len(T), 6))
    size = np.repeat(rng.uniform([1e-3, 2e-3], [3e-3, 5e-3], (count, 2)), 3, axis=1)
    direction = se3.unit(rng.normal(size=(count, 2, 3)))
    error[rng.permutation(len(T))[:count]] = size * direction.reshape(-1, 6)
    return se3.perturb(T, error)


# translations (n, 3) and quaternions (n, 4) to those that a wrong convention makes of them
PoseMap = Callable[[Array, Array], tuple[Array, Array]]


def _inverted(translation: Array, quaternion: Array) -> tuple[Array, Array]:
    T = se3.inverse(se3.from_quaternion(translation, quaternion))
    return T[:, :3, 3], se3.quaternion(T)


def _euler(quaternion: Array, read_as: str, factor: float) -> Array:
    angles = Rotation.from_quat(quaternion).as_euler('xyz') * factor
    return np.asarray(Rotation.from_euler(read_as, angles).as_quat())


WRONG_CONVENTIONS: dict[str, PoseMap] = {
    'inverted': _inverted,  # base in flange for flange in base
    # quaternions sent as w x y z
    'wxyz': lambda translation, quaternion: (translation, np.roll(quaternion, 1, axis=1)),
    'millimetres': lambda translation, quaternion: (translation * 1e3, quaternion),
    # roll, pitch, yaw in degrees taken for radians; of fixed axes taken for those of moving axes
    'degrees': lambda translation, quaternion: (
        translation, _euler(quaternion, 'xyz', 180 / np.pi)),
    'intrinsic': lambda translation, quaternion: (translation, _euler(quaternion, 'XYZ', 1.0)),
}
