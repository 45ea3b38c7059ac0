# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Rigid transforms: 4x4 arrays T_parent_child, p_parent = T_parent_child @ p_child.

A perturbation is (translation, rotation vector), both in the parent frame:
R = Exp(dr) R_hat, t = t_hat + dt, as in geometry_msgs.
"""
from __future__ import annotations

from collections.abc import Mapping
from typing import cast
import warnings

from handeye_ros.data import Array, TimedPose
import numpy as np
from scipy.spatial.transform import Rotation

AXES = ('x', 'y', 'z', 'rx', 'ry', 'rz')  # of a perturbation


def transform(rotation: Array, translation: Array) -> Array:
    """Return the (..., 4, 4) transform of (..., 3, 3) rotation and (..., 3) translation."""
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    T = np.zeros((*shape, 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, translation, 1.0
    return T


def inverse(T: Array) -> Array:
    """Return the inverse of (..., 4, 4) transforms."""
    R_transposed = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(R_transposed, -(R_transposed @ T[..., :3, 3:])[..., 0])


def apply(T: Array, points: Array) -> Array:
    """Return points (..., n, 3) of the child frame in the parent frame of T (..., 4, 4)."""
    return points @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3]


def exp_rotation(vector: Array) -> Array:
    """Return the (..., 3, 3) rotation of (..., 3) rotation vectors (radians)."""
    flat = Rotation.from_rotvec(np.array(vector).reshape(-1, 3)).as_matrix()
    return cast(Array, flat.reshape(*vector.shape, 3))


def log_rotation(R: Array) -> Array:
    """Return the (..., 3) rotation vectors (radians) of (..., 3, 3) rotations."""
    flat = _rotations(R).as_rotvec()
    return cast(Array, flat.reshape(*R.shape[:-2], 3))


def euler_angles(rotations: Rotation, axes: str) -> Array:
    """
    Return angles (n, 3) of rotations in radians; axes: as scipy, lower case for fixed ones.

    In gimbal lock, of which scipy warns, many triples are the same rotation: this is one of them.
    """
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', UserWarning)
        return np.asarray(rotations.as_euler(axes))


def _rotations(R: Array) -> Rotation:
    """Return (..., 3, 3) rotations, copied: SciPy 1.11 wants to be able to write to them."""
    return Rotation.from_matrix(np.array(R).reshape(-1, 3, 3))


def from_quaternion(translation: Array, quaternion: Array) -> Array:
    """Return the (..., 4, 4) transform of (..., 3) translation and (..., 4) x y z w."""
    flat = Rotation.from_quat(np.array(quaternion).reshape(-1, 4)).as_matrix()
    return transform(flat.reshape(*quaternion.shape[:-1], 3, 3), translation)


def of_pose(pose: TimedPose) -> Array:
    """Return T_base_flange (4, 4) of a pose."""
    return from_quaternion(pose.translation, pose.quaternion)


def quaternion(T: Array) -> Array:
    """Return the (..., 4) quaternion x y z w, w >= 0, of (..., 4, 4) transforms."""
    flat = _rotations(T[..., :3, :3]).as_quat(canonical=True)
    return cast(Array, flat.reshape(*T.shape[:-2], 4))


def transform_values(T: Array) -> dict[str, dict[str, float]]:
    """Return a transform (4, 4) as plain values: translation x y z, rotation x y z w."""
    return {'translation': dict(zip('xyz', map(float, T[:3, 3]), strict=True)),
            'rotation': dict(zip('xyzw', map(float, quaternion(T)), strict=True))}


def transform_from_values(values: Mapping[str, Mapping[str, float]]) -> Array:
    """Return the transform (4, 4) of plain values, as transform_values gives them."""
    translation, rotation = values['translation'], values['rotation']
    return from_quaternion(np.array([translation[axis] for axis in 'xyz']),
                           np.array([rotation[axis] for axis in 'xyzw']))


def rpy(T: Array) -> Array:
    """
    Return roll, pitch, yaw (radians; URDF: extrinsic x-y-z) of a (4, 4) transform.

    The roll is computed from the rotation that remains after the yaw. So the three angles are
    valid even at a pitch of 90 degrees, where the yaw alone is arbitrary.
    """
    R = T[:3, :3]
    yaw = np.arctan2(R[1, 0], R[0, 0])
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    sin, cos = np.sin(yaw), np.cos(yaw)
    roll = np.arctan2(sin * R[0, 2] - cos * R[1, 2], cos * R[1, 1] - sin * R[0, 1])
    return np.array([roll, pitch, yaw])


def perturb(T: Array, delta: Array) -> Array:
    """Return T (..., 4, 4) moved by delta (..., 6): t + delta[:3], Exp(delta[3:]) R."""
    return transform(exp_rotation(delta[..., 3:]) @ T[..., :3, :3],
                     T[..., :3, 3] + delta[..., :3])


def perturbation_jacobian(levers: Array) -> Array:
    """
    Return the derivatives (..., 3, 6) of points by a perturbation of their frame.

    levers (..., 3): from its origin to the points, in the axes of the parent frame.
    """
    wrt_shift = np.broadcast_to(np.eye(3), (*levers.shape, 3))
    return np.concatenate([wrt_shift, -skew(levers)], axis=-1)


def mapped_covariance(levers: Array, covariance: Array) -> Array:
    """Return the mean covariance (3, 3) of points at levers (k, 3), by that of their frame."""
    J = perturbation_jacobian(levers)
    return np.asarray(np.einsum('kij,jl,kml->im', J, covariance, J) / len(J))


def mean_square_form(levers: Array) -> Array:
    """Return M (6, 6): a perturbation d moves points at levers (k, 3) by d' M d, mean square."""
    J = perturbation_jacobian(levers).reshape(-1, 6)
    return J.T @ J / len(levers)


def mapped_std(levers: Array, covariance: Array) -> Array:
    """Return the RMS errors (...) of points at levers (k, 3), for covariances (..., 6, 6)."""
    return np.asarray(np.sqrt(np.einsum('...ij,ij->...', covariance, mean_square_form(levers))))


def difference(T: Array, T_reference: Array) -> Array:
    """Return the deltas (..., 6) with perturb(T_reference, delta) equal to T (..., 4, 4)."""
    turn = T[..., :3, :3] @ np.swapaxes(T_reference[..., :3, :3], -1, -2)
    return np.concatenate([T[..., :3, 3] - T_reference[..., :3, 3], log_rotation(turn)], axis=-1)


def angle(R: Array) -> Array:
    """Return the rotation angles (radians) of (..., 3, 3) rotations."""
    return cast(Array, np.linalg.norm(log_rotation(R), axis=-1))


def skew(v: Array) -> Array:
    """Return the matrices (..., 3, 3) of the cross product with vectors (..., 3)."""
    return np.cross(np.eye(3), v[..., None, :])


def unit(vectors: Array) -> Array:
    """Return vectors (..., k) at length 1."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def nearest_rotation(M: Array) -> Array:
    """Return the rotation nearest to M (3, 3) in the Frobenius norm."""
    U, _, V_transposed = np.linalg.svd(M)
    flip = np.array([1.0, 1.0, np.linalg.det(U @ V_transposed)])
    return cast(Array, (U * flip) @ V_transposed)


def align_points(points: Array, reference: Array) -> Array:
    """
    Return the transform (4, 4) of points (n, 3) that brings them nearest to others (n, 3).

    Least squares (Kabsch 1976, Acta Crystallographica A 32:922).
    """
    mean, reference_mean = points.mean(axis=0), reference.mean(axis=0)
    R = Rotation.align_vectors(reference - reference_mean, points - mean)[0].as_matrix()
    return transform(R, reference_mean - R @ mean)


def mean_pose(T: Array) -> Array:
    """Return the mean (4, 4) of close (n, 4, 4) transforms."""
    R = _rotations(T[:, :3, :3]).mean().as_matrix()
    return transform(R, T[:, :3, 3].mean(axis=0))


def turns_from_mean(T: Array) -> Array:
    """Return the rotation vectors (n, 3), rad, from the mean of transforms, in its own axes."""
    rotations = _rotations(T[:, :3, :3])
    return cast(Array, (rotations.mean().inv() * rotations).as_rotvec())


def weakest_direction(covariance: Array) -> tuple[float, Array]:
    """
    Return the largest 1 sigma of the translation (m) and its direction in the parent frame.

    covariance: (6, 6), or (3, 3) of a translation alone.
    """
    values, vectors = np.linalg.eigh(covariance[:3, :3])
    return float(np.sqrt(values[2])), vectors[:, 2]


def weakest_rotation(covariance: Array) -> tuple[float, Array]:
    """Return the largest 1 sigma of the rotation (rad) and its axis, by a covariance (6, 6)."""
    return weakest_direction(covariance[3:, 3:])
