# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The next pose: candidates around the stops so far, and what one more sample at each is worth.

Some stations of the solution are templates. From a template, a candidate is made by a turn of the
sensor, and a shift by which the same part of the target appears elsewhere in its view. The
template's points then move by least steps in the sensor plane until they fulfil the conditions of
the target, so that nothing else of the target needs to be known. A candidate counts if the sensor
sees what the template shows, with a margin: a stop that is off by STOP_POSE_ERROR gives a sample
too.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

from handeye_ros import se3
from handeye_ros.arithmetic import evenly_spaced
from handeye_ros.config import Config
from handeye_ros.data import Array, Sample, SEED
from handeye_ros.estimation.posterior import posterior_at
from handeye_ros.estimation.problem import Linearisation, linearise, Observations, Problem
from handeye_ros.estimation.solution import Solution
from handeye_ros.frames import mount_poses
from handeye_ros.guidance.view import BORDER_NORMALS, View
from handeye_ros.profiles.faces import MIN_CORNER_ANGLE
from handeye_ros.targets.starts import lines_of_parts
from handeye_ros.targets.wedge import corners
import numpy as np
from numpy.typing import NDArray

TEMPLATE_COUNT, CANDIDATES_EACH = 6, 500  # stations; candidates around each
STEPS_TO_TARGET = 3  # towards the target
MAX_STEP = 0.05  # m: an oblique crossing would throw a point further, out of any view
MAX_SHIFT = 0.2  # largest shift across the laser line of what is seen, in widths of the view
STOP_POSE_ERROR = (5e-3, 0.053)  # m and rad (3 degrees) by which a stop may be off
FAILED_POSE_DISTANCE = (1.5e-2, 0.12)  # m and rad around a pose at which a stop gave no sample
ON_TARGET = 1e-4  # m: largest residual of a point on the target
# m: the view is that of the points seen, the outermost of which are on its border
ON_BORDER = 1e-4
MIN_SHARE = 0.5  # smallest share of a feature's length in the view
MIN_COSINE = 0.5  # smallest cosine of the incidence on a face, if the template has it
CORNER_MARGIN = 0.34  # rad: a corner is this much sharper than it must be to be found


@dataclass(frozen=True, eq=False)
class Proposal:
    """
    The next pose, T_base_flange (4, 4), and the uncertainty expected after it.

    place: (2,) where in the sensor plane the feature will be seen; std: 1 sigma of mapped points
    with it (m).
    """

    T_base_flange: Array
    place: Array
    std: float


def propose(solution: Solution, samples: Sequence[Sample], config: Config, view: View,
            levers: Array, failed_poses: Sequence[Array] = ()) -> Proposal | None:
    """
    Return the pose that helps most, None if none keeps the target in view.

    The limits of guidance.* are relative to the first of samples; levers: (k, 3) of the points
    that it is to help, see view_levers; failed_poses: poses of the flange (4, 4) at which stops
    gave no sample.
    """
    rng, problem, X = np.random.default_rng(SEED), solution.problem, solution.estimate.X
    taken = np.array([sample.T_base_flange for sample in samples])
    lowest, best = float(se3.mapped_std(levers, solution.transform_covariance)), None
    for station in template_stations(problem):
        template = problem.subset(np.array([station]))
        T_sensor, places = _random_poses(template.poses[0] @ X, mount_poses(taken[0], config) @ X,
                                         anchor_of(template, 0), view, config, rng)
        poses = T_sensor @ se3.inverse(X)
        allowed = _allowed(mount_poses(poses, config), taken, failed_poses, config)
        candidates, places = stations_like(template, solution, poses[allowed], places[allowed],
                                           view)
        if not len(candidates.poses):
            continue
        stds = se3.mapped_std(levers, covariances_with_one_more(solution, candidates))
        i = int(np.argmin(stds))
        if stds[i] < lowest:
            lowest, best = stds[i], (candidates.subset(np.array([i])), places[i])
    if best is None:
        return None
    added, place = best
    return Proposal(mount_poses(added.poses[0], config), place,
                    std_with_one_more(solution, levers, added))


def template_stations(problem: Problem) -> list[int]:
    """Return some stations, at least one of each combination of conditions."""
    obs, groups = problem.observations, dict[bytes, list[int]]()
    for i in range(len(problem.poses)):
        groups.setdefault(np.unique(obs.kind[obs.station == i]).tobytes(), []).append(i)
    share = max(1, TEMPLATE_COUNT // len(groups))
    return [station for group in groups.values() for station in evenly_spaced(group, share)]


def anchor_of(problem: Problem, station: int) -> Array:
    """Return the anchor (2,) of a station: the mean of its edge points, or of all without any."""
    obs = problem.observations.select(problem.observations.station == station)
    return np.asarray(obs.points[_anchored(problem, obs)].mean(axis=0))


def _anchored(problem: Problem, obs: Observations) -> NDArray[np.bool_]:
    """Return which observations (m,) of a station the anchor is the mean of."""
    at_edge = np.isin(obs.kind, list(problem.target.edge_kinds))
    return at_edge if at_edge.any() else ~at_edge


def _random_poses(T: Array, first: Array, anchor: Array, view: View, config: Config,
                  rng: np.random.Generator) -> tuple[Array, Array]:
    """
    Return poses (n, 4, 4) of the sensor, and the places (n, 2) where each sees the anchor.

    T, first: (4, 4) poses of the sensor at the template and at the first sample; anchor: (2,)
    where it is seen in the template. Tilt and turn are within guidance.*; half of the tilts are
    the largest.
    """
    keys = config.guidance
    turn = keys.turn * rng.uniform(-1, 1, CANDIDATES_EACH)
    direction = rng.uniform(0, 2 * np.pi, CANDIDATES_EACH)
    tilt = keys.tilt * np.minimum(np.sqrt(rng.uniform(0, 2, CANDIDATES_EACH)), 0.99)
    tilt_axes = np.column_stack([np.cos(direction), np.sin(direction), np.zeros_like(direction)])
    R = (first[:3, :3] @ se3.exp_rotation(np.outer(turn, [0, 0, 1]))
         @ se3.exp_rotation(tilt[:, None] * tilt_axes))
    places = view.middle + rng.uniform(-1, 1, (CANDIDATES_EACH, 2)) * view.size / 2
    across = MAX_SHIFT * view.size[0] * rng.uniform(-1, 1, (CANDIDATES_EACH, 1)) * T[:3, 1]
    aim = T[:3, [0, 2]] @ anchor + T[:3, 3] + across  # what is seen at the place
    return se3.transform(R, aim - np.einsum('nij,nj->ni', R[:, :, [0, 2]], places)), places


def _allowed(flange: Array, taken: Array, failed_poses: Sequence[Array], config: Config
             ) -> NDArray[np.bool_]:
    """Return which poses (n, 4, 4) of the flange are within reach and unlike those visited."""
    sampling = config.sampling
    allowed = np.asarray(np.linalg.norm(
        flange[:, :3, 3] - taken[0, :3, 3], axis=1) <= config.guidance.reach)
    visited = [(T, FAILED_POSE_DISTANCE) for T in failed_poses]
    if sampling.new_translation and sampling.new_rotation:  # if either is 0, every stop is used
        near = (sampling.new_translation + STOP_POSE_ERROR[0],
                sampling.new_rotation + STOP_POSE_ERROR[1])
        visited += [(T, near) for T in taken]
    for T, (shift, angle) in visited:
        trace = np.einsum('nij,ij->n', flange[:, :3, :3], T[:3, :3])  # of the rotation between
        allowed &= ((np.linalg.norm(flange[:, :3, 3] - T[:3, 3], axis=1) >= shift)
                    | ((trace - 1) / 2 <= math.cos(angle)))
    return allowed


def stations_like(template: Problem, solution: Solution, poses: Array, places: Array, view: View
                  ) -> tuple[Problem, Array]:
    """
    Return the stations that see the target like a template (of one station), and their places.

    poses: (n, 4, 4) of the mount; places: (n, 2) of the anchor in the sensor plane (m). Poses from
    which the target is not seen so are dropped.
    """
    obs = template.observations
    anchored, same_point = _anchored(template, obs), obs.station_groups[0].same_point[0]

    # move the template's points, and cut what is then outside the view
    points = obs.points - obs.points[anchored].mean(axis=0) + places[:, None]
    points = _moved_onto_target(template, solution, poses, points, same_point)
    anchors = points[:, anchored].mean(axis=1, keepdims=True)
    outward = np.maximum((points - anchors) @ BORDER_NORMALS.T, 1e-9)
    room = view.offsets - anchors @ BORDER_NORMALS.T
    share = np.clip((room / outward).min(axis=(1, 2)), 0.0, 1.0)
    points = anchors + share[:, None, None] * (points - anchors)
    large = share > MIN_SHARE
    poses, points = poses[large], points[large]
    points = _moved_onto_target(template, solution, poses, points, same_point)
    linear = _linear(template, solution, poses, points)
    visible = np.flatnonzero(_shows_the_same(
        linear, linearise(template, solution.estimate), same_point, view))
    return linear.problem.subset(visible), points[visible][:, anchored].mean(axis=1)


def _shows_the_same(linear: Linearisation, template: Linearisation, same_point: Array, view: View
                    ) -> NDArray[np.bool_]:
    """
    Return which stations (n,) of linear see the target as the template, of one station, does.

    That is, all points are in view and on the target, edges and faces are crossed steeply, faces
    are seen from the same side, and the corner of two faces is sharp and in view.

    same_point: (c, c) 1 where two conditions are of one point, else 0.
    """
    problem, shape = template.problem, (len(linear.problem.poses), len(same_point))
    points = linear.problem.observations.points.reshape(*shape, 2)
    in_view = view.room(points).min(axis=1) > -ON_BORDER
    on_target = np.abs(linear.residuals).reshape(shape).max(axis=1) < ON_TARGET
    # the crossing is steep: moves along the laser line show at edges, in the plane at faces
    A = linear.wrt_point.reshape(*shape, 2)
    at_edge = np.isin(problem.observations.kind, list(problem.target.edge_kinds)) @ same_point > 0
    sine_squared = np.where(at_edge, A[..., 0] ** 2, (A ** 2).sum(axis=2)) @ same_point
    crossing = problem.config.sampling.min_crossing_angle + STOP_POSE_ERROR[1]
    # surfaces are seen from the same side, where the template tells one
    wrt_range = template.wrt_point[:, 1]  # of single conditions it depends on the choice of axes
    size = np.sqrt(wrt_range ** 2 @ same_point)
    same_side = (A[..., 1] * wrt_range) @ same_point > MIN_COSINE * size
    two_faces = problem.target.face_count == 2
    right = (sine_squared > np.sin(crossing) ** 2) & (
        same_side | (size <= MIN_COSINE) & (not two_faces))
    corner = (_corner_seen(linear.problem.observations, view) if two_faces and len(points)
              else np.True_)
    return np.asarray(in_view & on_target & right.all(axis=1) & corner)


def _corner_seen(observations: Observations, view: View) -> NDArray[np.bool_]:
    """Return which stations (n,) have the corner of two faces in view, and sharp enough."""
    places, _ = corners(observations, np.zeros_like(observations.kind))
    _, _, slopes = lines_of_parts(observations, observations.kind)
    sine = np.sin(np.ptp(np.arctan(slopes), axis=1))
    return np.asarray((view.room(places[:, 0]) > 0)
                      & (sine > np.sin(MIN_CORNER_ANGLE + CORNER_MARGIN)))


def _linear(template: Problem, solution: Solution, poses: Array, points: Array) -> Linearisation:
    """
    Return the conditions of stations like the template, linearised at the solution's estimate.

    poses: (n, 4, 4); points: (n, c, 2).
    """
    observations = template.observations.repeated(len(poses), points.reshape(-1, 2))
    return linearise(replace(template, poses=poses, observations=observations), solution.estimate)


def _moved_onto_target(template: Problem, solution: Solution, poses: Array, points: Array,
                       same_point: Array) -> Array:
    """
    Return points (n, c, 2) of the sensor plane moved onto the target by least steps.

    poses: (n, 4, 4) of the mount; same_point: (c, c) 1 where two conditions are of one point.
    """
    shape = points.shape[:2]
    for _ in range(STEPS_TO_TARGET):
        linear = _linear(template, solution, poses, points)
        g, A = linear.residuals.reshape(*shape, 1), linear.wrt_point.reshape(*shape, 2)
        normal = np.einsum('cd,ndi,ndj->ncij', same_point, A, A) + 1e-6 * np.eye(2)
        step = np.linalg.solve(normal, (same_point @ (A * g))[..., None])[..., 0]
        points = points - np.clip(step, -MAX_STEP, MAX_STEP)
    return points


def covariances_with_one_more(solution: Solution, candidates: Problem) -> Array:
    """
    Return the covariances (n, 6, 6) of the transform, each with one of n further stations.

    candidates: with equally many observations at each. Of further blocks only those that count as
    errors of the station, see blocks_as_noise, are in it.
    """
    Sigma = solution.reported_covariance
    noise = replace(solution.posterior.noise, blocks_as_noise=True)
    A = posterior_at(candidates, solution.estimate, noise).jacobian
    A = A.reshape(len(candidates.poses), -1, len(Sigma))
    # (Sigma^-1 + A'A)^-1 = Sigma - Sigma A' (1 + A Sigma A')^-1 A Sigma: one small inverse
    A_Sigma = A @ Sigma
    inner = A_Sigma @ np.swapaxes(A, 1, 2) + np.eye(A.shape[1])
    of_transform = A_Sigma[:, :, :6]
    return np.asarray(Sigma[:6, :6] - np.swapaxes(of_transform, 1, 2)
                      @ np.linalg.solve(inner, of_transform))


def std_with_one_more(solution: Solution, levers: Array, added: Problem) -> float:
    """
    Return the reported 1 sigma of points at levers (k, 3) (m) expected with one more station.

    added: the problem of that station alone. Here all blocks are shared with the others.
    """
    reported = solution.report_posterior
    problem = reported.problem
    further = replace(added.observations,
                      station=added.observations.station + len(problem.poses))
    with_added = replace(problem, poses=np.concatenate([problem.poses, added.poses]),
                         observations=Observations.concatenated([problem.observations, further]))
    posterior = posterior_at(with_added, reported.estimate, reported.noise)
    now, before, after = (float(se3.mapped_std(levers, covariance[:6, :6])) for covariance in (
        solution.transform_covariance, reported.covariance, posterior.covariance))
    return now * min(after / before, 1.0)
