# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Which poses may be proposed: the limits of guidance.*, and the conditions of a valid sample.

Each rule has a margin: a stop that is off by ERROR gives a sample too.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array, Sample
from handeye_ros.estimation.problem import Linear
from handeye_ros.guidance.score import View
from handeye_ros.targets.common import EdgeObservations
import numpy as np
from numpy.typing import NDArray

ERROR = (5e-3, 0.053)  # m and rad (3 degrees) by which a stop may be off
REFUSED = (1.5e-2, 0.12)  # m and rad around a pose at which a stop gave no sample
SMALLEST_CORNER = 0.6  # rad between two faces in a profile; the finder needs 0.26
SMALLEST_COSINE = 0.5  # smallest cosine of the incidence on a face, if the template has it
SHORTEST = 0.25  # smallest visible part of a face, over that in the template
SMALLEST_FACE = 0.2  # smallest visible length of a face beside its edge, over the view's width


@dataclass(frozen=True, eq=False)
class Limits:
    """
    The limits of guidance.* around the first sample.

    first: (4, 4) pose of the mount in the target frame; in_hand: True: the flange in the base,
    False: the base in the flange. Largest differences: reach (m), tilt of the viewing direction
    (rad), turn about it (rad).
    """

    first: Array
    in_hand: bool
    reach: float
    tilt: float
    turn: float

    def allow(self, poses: Array, X: Array) -> NDArray[np.bool_]:
        """Return which poses (n, 4, 4) are within the limits, for a sensor at X (4, 4)."""
        T, first = (poses, self.first) if self.in_hand else (
            se3.inverse(poses), se3.inverse(self.first))
        away = np.linalg.norm(T[:, :3, 3] - first[:3, 3], axis=1)
        first_sensor, sensors = self.first[:3, :3] @ X[:3, :3], poses[:, :3, :3] @ X[:3, :3]
        tilted = np.arccos(np.clip(sensors[:, :, 2] @ first_sensor[:, 2], -1.0, 1.0))
        twisted = np.abs(twist_of(first_sensor, sensors))
        return np.asarray((away <= self.reach) & (tilted <= self.tilt) & (twisted <= self.turn))


def twist_of(first: Array, R: Array) -> Array:
    """
    Return the rotation (n,) rad of sensors R (n, 3, 3) about the viewing direction.

    The rotation from the first (3, 3) is one about the viewing direction, then a tilt.
    """
    relative = first.T @ R
    # of the quaternion only z and w, up to a factor
    z = relative[:, 1, 0] - relative[:, 0, 1]
    w = 1 + relative[:, 0, 0] + relative[:, 1, 1] + relative[:, 2, 2]
    return np.asarray(2 * np.arctan2(z, w))


def limits_of(first: Array, config: Config) -> Limits:
    """Return the limits of a configuration around the first sample's pose (4, 4), mounted."""
    keys = config.guidance
    return Limits(first, config.calibration_type == 'eye_in_hand', keys.reach, keys.tilt,
                  keys.turn)


@dataclass(frozen=True, eq=False)
class Visited:
    """Flange poses of stops: with a sample, taken (n, 4, 4); without, refused (k, 4, 4)."""

    taken: Array
    refused: Array
    margin: tuple[float, float]
    config: Config

    @property
    def careful(self) -> bool:
        """Return whether a margin is required."""
        return any(self.margin)

    def allow(self, poses: Array) -> NDArray[np.bool_]:
        """Return which flange poses (m, 4, 4) differ from all visited ones, with a margin."""
        sampling = self.config.sampling
        new = (sampling.new_translation, sampling.new_rotation)
        apart = (new[0] + self.margin[0], new[1] + self.margin[1])
        allowed = np.ones(len(poses), dtype=bool)
        if new[0] and new[1]:  # if either is 0, every stop is used
            allowed &= _away(poses, self.taken, apart)
        return allowed & _away(poses, self.refused, REFUSED)


def visited(samples: Sequence[Sample], refused: Sequence[Array], config: Config,
            margin: tuple[float, float] = ERROR) -> Visited:
    """Return the visited poses; refused: poses of the flange at which no sample was taken."""
    return Visited(np.array([s.T_base_flange for s in samples]).reshape(-1, 4, 4),
                   np.array(refused).reshape(-1, 4, 4), margin, config)


def _away(poses: Array, others: Array, least: tuple[float, float]) -> NDArray[np.bool_]:
    """Return which poses (m, 4, 4) are distinct from all others (n, 4, 4)."""
    distance = np.linalg.norm(poses[:, None, :3, 3] - others[None, :, :3, 3], axis=2)
    trace = np.einsum('mij,nij->mn', poses[:, :3, :3], others[:, :3, :3])
    angle = np.arccos(np.clip((trace - 1) / 2, -1.0, 1.0))
    return np.asarray(((distance >= least[0]) | (angle >= least[1])).all(axis=1))


def stricter(config: Config) -> Config:
    """Return the configuration for proposals, with a larger least angle at edges."""
    sampling = config.sampling
    return replace(config, sampling=replace(
        sampling, min_crossing_angle=sampling.min_crossing_angle + ERROR[1]))


def crossing_steeply(linear: Linear, count: int) -> NDArray[np.bool_]:
    """
    Return at which of n stations the laser line crosses the edges at a sufficient angle.

    linear: with count conditions at each station. The conditions of one edge point are combined:
    alone, each distance from a line in space depends on the choice of axes across the line.
    """
    problem = linear.problem
    _, point = np.unique(problem.observations.points, axis=0, return_inverse=True)
    size = np.maximum(np.linalg.norm(linear.by_base, axis=-1), 1e-12)
    squares = np.bincount(point.reshape(-1), (linear.by_point[:, 0] / size) ** 2)
    steepness = np.sqrt(squares)[point.reshape(-1)]
    least = np.sin(stricter(problem.config).sampling.min_crossing_angle)
    of_edges = np.isin(problem.observations.kind, problem.method.essential_kinds)
    return np.asarray((~of_edges | (steepness > least)).reshape(-1, count).all(axis=1))


@dataclass(frozen=True, eq=False)
class FaceBeside:
    """The face beside an edge: normal (3,), and direction (3,) from the edge into the face."""

    normal: Array
    inward: Array

    def room(self, poses: Array, points: Array, view: View) -> Array:
        """Return the visible length (n,) of the face beside edge points (n, 2), m."""
        along = np.cross(self.normal, poses[:, :3, 1])
        along *= np.sign(along @ self.inward)[:, None]
        plane = np.einsum('nij,ni->nj', poses[:, :3, :3], along)[:, [0, 2]]
        plane /= np.maximum(np.linalg.norm(plane, axis=1), 1e-12)[:, None]
        outward = np.maximum(plane @ view.normals.T, 1e-9)
        return np.asarray(((view.offsets - points @ view.normals.T) / outward).min(axis=1))


def face_beside(linear: Linear) -> FaceBeside | None:
    """Return the face of a station with edge points only; None if it has face conditions."""
    problem, obs = linear.problem, linear.problem.observations
    if not isinstance(obs, EdgeObservations) or len(obs) != 2 or np.ptp(obs.points, axis=0).any():
        return None
    outward = (problem.poses[obs.station[0]] @ linear.estimate.X)[:3, [0, 2]] @ obs.outward[0]
    edge = np.cross(*linear.by_base)
    normal = np.cross(edge, outward)
    inward = np.cross(edge, normal)
    return FaceBeside(normal, inward * -np.sign(inward @ outward))


@dataclass(frozen=True, eq=False)
class Corners:
    """
    The corner of two faces in each of n profiles.

    points: (n, 2) in the sensor plane; angle: (n,) between the faces in the profile (rad); reach:
    (n, 2) signed distance of the middle of each visible face from the corner, across the edge
    (m); facing: (n, 2) cosine between each face's normal and the viewing direction.
    """

    points: Array
    angle: Array
    reach: Array
    facing: Array


def corners(linear: Linear, count: int) -> Corners | None:
    """Return the corners of a target without edge points; None for other targets."""
    problem, obs = linear.problem, linear.problem.observations
    if problem.method.essential or len(problem.method.kinds) != 2:
        return None
    kind = obs.kind.reshape(-1, count)
    first, second = (_face(linear, kind == k, count) for k in (0, 1))
    A = np.stack([first[0], second[0]], axis=1)
    height = np.stack([(first[0] * first[1]).sum(axis=1), (second[0] * second[1]).sum(axis=1)],
                      axis=1)
    sine = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
    singular = np.abs(sine) < 1e-6
    A[singular] = np.eye(2)
    points = np.linalg.solve(A, height[..., None])[..., 0]
    at = replace(problem, observations=replace(
        obs, points=np.repeat(points, count, axis=0)))
    corner = at.points_in_base(linear.estimate.X).reshape(-1, count, 3)[:, 0]
    edge = np.cross(first[3], second[3])
    reach = [((middle - corner) * np.cross(normal, edge)).sum(axis=1)
             for _, _, middle, normal, _ in (first, second)]
    angle = np.where(singular, 0.0, np.arcsin(np.minimum(np.abs(sine), 1.0)))
    facing = np.stack([first[4], second[4]], axis=1)
    return Corners(points, angle, np.stack(reach, axis=1), facing)


def _face(linear: Linear, rows: NDArray[np.bool_], count: int) -> tuple[Array, ...]:
    """
    Return the visible part of one face at n stations; rows (n, count): its conditions.

    Its normal (n, 2) and middle (n, 2) in the sensor plane, middle and normal (n, 3) in the base,
    and the cosine (n,) between normal and viewing direction.
    """
    p = linear.problem.points_in_base(linear.estimate.X)
    share = rows / np.maximum(rows.sum(axis=1, keepdims=True), 1)

    def mean(values: Array) -> Array:
        return np.asarray(np.einsum('nc,nci->ni', share, values.reshape(*rows.shape, -1)))

    normal = mean(linear.by_point)
    facing = normal[:, 1].copy()
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return normal, mean(linear.problem.observations.points), mean(p), mean(linear.by_base), facing


def meeting(corners: Corners | None, template: Corners | None, strict: bool
            ) -> NDArray[np.bool_] | None:
    """
    Return which corners show both faces as the template does; None: no corner.

    strict: no face at a flatter angle than SMALLEST_COSINE, whatever the template saw.
    """
    if corners is None or template is None:
        return None
    sides = corners.reach * np.sign(template.reach) > SHORTEST * np.abs(template.reach)
    least = SMALLEST_COSINE if strict else np.minimum(SMALLEST_COSINE, abs(template.facing))
    facing = corners.facing * np.sign(template.facing) >= least
    return np.asarray((sides & facing).all(axis=1) & (corners.angle > SMALLEST_CORNER))
