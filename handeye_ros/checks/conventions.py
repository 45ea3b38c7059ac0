# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Hypotheses about the poses: the same stops, with a known error of conventions undone.

A function of the published poses T (n, 4, 4) gives the poses without the error; of an error that
can be undone in two ways, both. The one with which the samples agree names the mistake.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

from handeye_ros import se3
from handeye_ros.arithmetic import evenly_spaced
from handeye_ros.checks.hypotheses import (
    explain_problem,
    explain_samples,
    Explanation,
    Hypothesis,
)
from handeye_ros.data import Array, Sample
from handeye_ros.errors import DataError
from handeye_ros.estimation.problem import Problem
from handeye_ros.frames import mount_poses
from handeye_ros.sampling.sweep import SEARCH_SAMPLES
import numpy as np
from scipy.spatial.transform import Rotation


def convention_hypotheses(samples: Sequence[Sample], problem: Problem, baseline: Explanation
                          ) -> Iterator[Hypothesis]:
    """
    Yield the hypotheses that the poses have a known error.

    samples: of the stations, in order. Of a sweep the error is undone in all poses, and the clocks
    are searched anew, as those that were found are of the wrong poses; some stations are enough.
    """
    config, poses = problem.config, problem.robot_poses
    trajectory = next((sample.trajectory for sample in samples if sample.moving), None)
    if trajectory:
        samples = evenly_spaced(samples, SEARCH_SAMPLES)
        poses = se3.from_quaternion(trajectory.values[:, :3], trajectory.values[:, 3:])
    stamps = [sample.stamp for sample in samples]

    def explained_with(T: Array) -> Explanation:
        if not trajectory:
            return explain_problem(replace(problem, poses=mount_poses(T, config)), stamps)
        corrected = replace(trajectory, values=np.column_stack([T[:, :3, 3], se3.quaternion(T)]))
        return explain_samples([replace(sample, trajectory=corrected) for sample in samples],
                               config, stamps, clocks=True)

    for name, undone, advice in CONVENTION_ERRORS:
        for explanation in map(explained_with, undone(poses)):
            comparison = explanation.comparison_in_words(
                baseline, f'{name} undone'.format(other=config.other_calibration_type))
            yield Hypothesis(explanation, DataError(
                f'the poses contradict the samples: {comparison}; '
                f'{advice.format(other=config.other_calibration_type)}', code='convention'))


def orientations_scatter(poses: Array) -> bool:
    """
    Return whether no tool axis stays within one half space over poses (n, 4, 4).

    The viewing axis of a sensor that sees its target does stay; wrapped angles look random.
    """
    # largest mean cosine between a tool axis and one fixed direction
    return float(np.linalg.norm(poses[:, :3, :3].mean(axis=0), 2)) < 0.6


def _composed(read_as: str, meant: str, T: Array, factor: float = 1.0) -> list[Array]:
    """Undo angles about the axes `meant` that were composed as `read_as`; factor: on them."""
    angles = se3.euler_angles(Rotation.from_matrix(T[:, :3, :3]), read_as) * factor
    return [se3.transform(Rotation.from_euler(meant, angles).as_matrix(), T[:, :3, 3])]


def _rotation_vectors(T: Array) -> list[Array]:
    """
    Undo rotation vectors of at most half a turn read as roll, pitch, yaw.

    Two triples of angles give the same rotation. Of those that may be such a vector, each is the
    one whose rotation is nearest to that of the first pose, for which either is tried.
    """
    angles = se3.euler_angles(Rotation.from_matrix(T[:, :3, :3]), 'xyz')
    same_rotation = (angles * [1, -1, 1] + 2 * np.pi) % (2 * np.pi) - np.pi
    vectors = np.stack([angles, same_rotation])
    possible = np.linalg.norm(vectors, axis=2) <= np.pi
    R = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(2, -1, 3, 3)
    nearest = [np.where(possible, np.einsum('cnij,ij->cn', R, first), -np.inf).argmax(axis=0)
               for first in R[:, 0]]
    return [se3.transform(R[choice, np.arange(len(T))], T[:, :3, 3]) for choice in nearest]


# Name, function that undoes it, and what to do.
CONVENTION_ERRORS: Sequence[tuple[str, Callable[[Array], list[Array]], str]] = (
    ('calibration_type {other} or inverse poses', lambda T: [se3.inverse(T)],
     'set calibration_type to {other} if the sensor is mounted so; otherwise publish the pose of '
     'the flange in the base (p_base = T p_flange), not its inverse'),
    ('quaternions read as w x y z',
     lambda T: [se3.from_quaternion(T[:, :3, 3], np.roll(se3.quaternion(T), -1, axis=1))],
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
    ('roll and yaw exchanged', partial(_composed, 'xyz', 'ZYX'),
     'the angles came in the order yaw, pitch, roll, as the A, B, C of KUKA do (about z, y, x), '
     'but were taken as roll, pitch, yaw; compose them as Rz(A) Ry(B) Rx(C)'),
    ('rotation vectors', _rotation_vectors,
     'the orientations are rotation vectors, as Universal Robots gives them, but were read as '
     'roll, pitch, yaw; turn by their length about their direction'),
)
