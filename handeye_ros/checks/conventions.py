# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Common errors of conventions in the poses, as hypotheses where an answer does not fit.

Each error can be undone: a function of the published poses T (n, 4, 4) gives the poses without it,
of some errors in one of two ways. The one with which the samples agree names the mistake.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from handeye_ros import se3
from handeye_ros.checks.hypotheses import (
    Explanation,
    explanation_of_problem,
    explanation_of_results,
    Hypothesis,
    refuse_better,
)
from handeye_ros.data import Array, Sample
from handeye_ros.errors import DataError
from handeye_ros.estimation.problem import Problem
from handeye_ros.frames import mount_poses
from handeye_ros.sampling.stops import evenly_chosen
from handeye_ros.sampling.sweep import FEWER_SAMPLES
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


def require_convention(samples: Sequence[Sample], problem: Problem, stated: Explanation) -> None:
    """
    Raise DataError (convention) where the stations agree without a known error of the poses.

    samples: of the stations, in order. Of a sweep the error is undone in all poses, and the clocks
    are searched anew, as those that were found are of the wrong poses; some stations are enough.
    """
    other = 'eye_on_base' if problem.config.in_hand else 'eye_in_hand'
    trajectory = next((sample.trajectory for sample in samples if sample.moving), None)
    poses = problem.robot_poses
    if trajectory:
        some = evenly_chosen(len(samples), FEWER_SAMPLES)
        samples = [samples[i] for i in some]
        stated = replace(stated, squares=stated.squares[:, some])
        poses = se3.from_quaternion(trajectory.values[:, :3], trajectory.values[:, 3:])

    def refit(T: Array) -> Explanation:
        if trajectory is None:
            return explanation_of_problem(replace(problem, poses=mount_poses(T, problem.config)))
        moved = replace(trajectory, values=np.column_stack([T[:, :3, 3], se3.quaternion(T)]))
        return explanation_of_results([replace(sample, trajectory=moved) for sample in samples],
                                      problem.config)

    def undone(name: str, T: Array, advice: str) -> Hypothesis:
        """Return the hypothesis that T (n, 4, 4) are the poses without an error."""
        return Hypothesis(partial(refit, T), lambda fit: DataError(
            'the poses contradict the samples: '
            f'{fit.compared(stated, f"{name} undone".format(other=other))}; '
            f'{advice.format(other=other)}', reason='convention'))
    refuse_better(stated, [undone(name, T, advice) for name, undo, advice in CONVENTION_ERRORS
                           for T in undo(poses)])


def orientations_scatter(poses: Array) -> bool:
    """
    Return whether no tool axis stays within one half space over poses (n, 4, 4).

    The viewing axis of a sensor that sees its target does stay; wrapped angles look random.
    """
    # largest mean cosine between a tool axis and one fixed direction
    return float(np.linalg.norm(poses[:, :3, :3].mean(axis=0), 2)) < 0.6


def _wxyz(T: Array) -> list[Array]:
    """Undo quaternions x y z w read as w x y z."""
    w, x, y, z = np.moveaxis(Rotation.from_matrix(T[:, :3, :3]).as_quat(), -1, 0)
    return [se3.from_quaternion(T[:, :3, 3], np.column_stack([x, y, z, w]))]


def _composed(read_as: str, meant: str, T: Array, factor: float = 1.0) -> list[Array]:
    """Undo angles about the axes `meant` that were composed as `read_as`, over a factor."""
    angles = Rotation.from_matrix(T[:, :3, :3]).as_euler(read_as) * factor
    return [se3.transform(Rotation.from_euler(meant, angles).as_matrix(), T[:, :3, 3])]


def _reversed(T: Array) -> list[Array]:
    """Undo yaw, pitch, roll taken for roll, pitch, yaw."""
    return _two_ways(T, Rotation.from_euler('xyz', _both_rpy(T).reshape(-1, 3)[:, ::-1]))


def _rotation_vectors(T: Array) -> list[Array]:
    """Undo rotation vectors of at most half a turn read as roll, pitch, yaw."""
    both = _both_rpy(T)
    return _two_ways(T, Rotation.from_rotvec(both.reshape(-1, 3)),
                     np.linalg.norm(both, axis=2) <= np.pi)


def _both_rpy(T: Array) -> Array:
    """Return the two solutions (2, n, 3) of roll, pitch, yaw for each rotation."""
    one = Rotation.from_matrix(T[:, :3, :3]).as_euler('xyz')
    other = one * [1, -1, 1] + np.pi
    return np.stack([one, (other + np.pi) % (2 * np.pi) - np.pi])


def _two_ways(T: Array, rotations: Rotation, valid: NDArray[np.bool_] | None = None
              ) -> list[Array]:
    """
    Return the poses with one of two rotations (2 n) each; either way for the first pose.

    valid: (2, n) which of them are possible, None: all. The pose with a rotation nearest to that
    of a decided pose is decided next.
    """
    n, readings = len(T), []
    R = rotations.as_matrix().reshape(2, n, 3, 3)
    able = np.ones(R.shape[:2], dtype=bool) if valid is None else valid | ~valid.any(axis=0)
    for first in range(2):
        chosen, undecided = np.full(n, first), np.ones(n, dtype=bool)
        nearness, pick, pose = np.full(R.shape[:2], -np.inf), first, 0
        for _ in range(n):
            chosen[pose], undecided[pose] = pick, False
            nearness = np.maximum(nearness, np.einsum('cnij,ij->cn', R, R[pick, pose]))
            best = int(np.argmax(np.where(undecided & able, nearness, -np.inf)))
            pick, pose = divmod(best, n)
        readings.append(se3.transform(R[chosen, np.arange(n)], T[:, :3, 3]))
    return readings


# Name, function that undoes it, and what to do.
CONVENTION_ERRORS: Sequence[tuple[str, Callable[[Array], list[Array]], str]] = (
    ('calibration_type {other} or inverse poses', lambda T: [se3.inverse(T)],
     'set calibration_type to {other} if the sensor is mounted so; otherwise publish the pose of '
     'the flange in the base (p_base = T p_flange), not its inverse'),
    ('quaternions read as w x y z', _wxyz,
     'fill x, y, z, w of the message by name, not in the order w x y z'),
    ('positions in millimetres', lambda T: [se3.transform(T[:, :3, :3], T[:, :3, 3] * 1e-3)],
     'publish positions in metres'),
    ('extrinsic Euler angles', partial(_composed, 'XYZ', 'xyz'),
     'the angles were composed as intrinsic x-y-z; compose them as extrinsic x-y-z (Rz Ry Rx)'),
    ('intrinsic Euler angles', partial(_composed, 'xyz', 'XYZ'),
     'the angles were composed as extrinsic x-y-z; compose them as intrinsic x-y-z (Rx Ry Rz)'),
    ('angles in radians', partial(_composed, 'xyz', 'xyz', factor=np.degrees(1)),
     'the angles are radians but were converted as degrees; convert them once only'),
    ('transposed rotations',
     lambda T: [se3.transform(np.swapaxes(T[:, :3, :3], 1, 2), T[:, :3, 3])],
     'publish the rotation of the flange in the base, not its transpose'),
    ('roll and yaw exchanged', _reversed,
     'the angles came in the order yaw, pitch, roll, as the A, B, C of KUKA do (about z, y, x), '
     'but were taken as roll, pitch, yaw; compose them as Rz(A) Ry(B) Rx(C)'),
    ('rotation vectors', _rotation_vectors,
     'the orientations are rotation vectors, as Universal Robots gives them, but were read as '
     'roll, pitch, yaw; turn by their length about their direction'),
)
