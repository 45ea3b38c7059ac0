# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Predicted views: the features at other poses, from a template station.

The points of the template take least steps in the sensor's plane until the conditions of the
method hold, so that nothing else of the target needs to be known.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

from handeye_ros.data import Array
from handeye_ros.estimation.problem import Estimate, linearise, Problem
from handeye_ros.guidance import rules
from handeye_ros.guidance.score import View
import numpy as np
from numpy.typing import NDArray

ON_TARGET = 1e-4  # m: largest residual of a point on the target
SMALLEST_SHARE = 0.5  # smallest share of a feature's length in the view


@dataclass(frozen=True, eq=False)
class Batch:
    """
    n stations at other poses that show the same parts of the target as a template.

    problem: c observations for each station; anchored: indices of those that define the anchor
    (see anchor_rows); groups: arrays (points, r), the observations of points with r of them each;
    seen: (c,) derivatives of the template's conditions by the range; corner: of its two faces,
    None for other targets; face: beside the edge if only an edge is visible, else None.
    """

    problem: Problem
    estimate: Estimate
    anchored: NDArray[np.intp]
    groups: tuple[NDArray[np.intp], ...]
    seen: Array
    corner: rules.Corners | None
    face: rules.FaceBeside | None

    def __len__(self) -> int:
        """Return the number of stations."""
        return len(self.problem.poses)

    @property
    def points(self) -> Array:
        """Return what was observed in the sensor plane, (n, c, 2)."""
        return self.problem.observations.points.reshape(len(self), len(self.seen), 2)

    @property
    def anchors(self) -> Array:
        """Return the anchor of each station, (n, 2), in the sensor plane."""
        return np.asarray(self.points[:, self.anchored].mean(axis=1))

    def subset(self, stations: NDArray[np.intp]) -> Batch:
        """Return the batch with only the given stations (ascending indices)."""
        return replace(self, problem=self.problem.subset(stations))

    def moved(self, points: Array) -> Batch:
        """Return the batch with other points (n, c, 2)."""
        observations = replace(self.problem.observations, points=points.reshape(-1, 2))
        return replace(self, problem=replace(self.problem, observations=observations))


def anchor_rows(problem: Problem, station: int) -> NDArray[np.intp]:
    """Return the observations that define the anchor of a station: those of edges, if any."""
    obs = problem.observations
    rows = np.flatnonzero(obs.station == station)
    at_edge = rows[np.isin(obs.kind[rows], problem.method.essential_kinds)]
    return at_edge if len(at_edge) else rows


def anchor_of(problem: Problem, station: int) -> Array:
    """Return the anchor (2,) of a station: the mean of its edge points, or of all points."""
    return np.asarray(problem.observations.points[anchor_rows(problem, station)].mean(axis=0))


def batch_of(template: Problem, estimate: Estimate, poses: Array, anchors: Array) -> Batch:
    """
    Return a batch at poses (n, 4, 4), its points not yet moved onto the target.

    template: problem of one station; anchors: (n, 2) new places of its anchor in the sensor plane.
    """
    obs, n, linear = template.observations, len(poses), linearise(template, estimate)
    anchored = anchor_rows(template, int(obs.station[0]))
    anchor = obs.points[anchored].mean(axis=0)
    _, which = np.unique(obs.points, axis=0, return_inverse=True)
    count = np.bincount(which.reshape(-1))
    order = np.argsort(which.reshape(-1), kind='stable')
    groups = tuple(order[np.repeat(count, count) == r].reshape(-1, r) for r in np.unique(count))
    points = obs.points[None] + (anchors - anchor)[:, None]
    many = obs.repeated(n, points.reshape(-1, 2))
    return Batch(replace(template, poses=poses, observations=many), estimate, anchored, groups,
                 linear.by_point[:, 1], rules.corners(linear, len(obs)), rules.face_beside(linear))


def predicted(batch: Batch, view: View, strict: bool = True) -> tuple[Batch, NDArray[np.intp]]:
    """Return the stations that see the target like the template, and their indices."""
    kept = np.arange(len(batch))
    if len(batch):
        batch, share = _fitted(_on_target(batch), view)
        kept = np.flatnonzero(share > SMALLEST_SHARE)
        batch = batch.subset(kept)
    if not len(batch):
        return batch, kept
    batch = _on_target(batch)
    linear = linearise(batch.problem, batch.estimate)
    by_point = linear.by_point.reshape(len(batch), -1, 2)
    near = np.abs(linear.residuals).reshape(len(batch), -1).max(axis=1) < ON_TARGET
    inside = view.room(batch.points).min(axis=1) > -1e-4
    good = near & inside & _steep(batch, by_point)
    good &= _facing(batch, by_point) & _recognised(batch)
    good &= rules.crossing_steeply(linear, len(batch.seen))
    corners = rules.corners(linear, len(batch.seen))
    meeting = rules.meeting(corners, batch.corner, strict)
    if corners is not None and meeting is not None:
        good &= meeting & (view.room(corners.points) > 0)
    if batch.face and strict:
        room = batch.face.room(batch.problem.poses @ batch.estimate.X, batch.anchors, view)
        good &= room > rules.SMALLEST_FACE * view.size[0]
    stations = np.flatnonzero(good)
    return batch.subset(stations), kept[stations]


def _on_target(batch: Batch) -> Batch:
    """Return the batch with its points moved onto the target by least steps."""
    for _ in range(4):
        linear = linearise(batch.problem, batch.estimate)
        g, A = linear.residuals.reshape(len(batch), -1), linear.by_point
        A = A.reshape(len(batch), -1, 2)
        points = batch.points.copy()
        for rows in batch.groups:
            step = _least_step(A[:, rows], g[:, rows])
            points[:, rows] -= np.clip(step, -0.05, 0.05)[:, :, None]
        batch = batch.moved(points)
    return batch


def _least_step(A: Array, g: Array) -> Array:
    """
    Return the shortest x (n, k, 2) with A x = g for each of k points, regularised.

    A: (n, k, r, 2) and g: (n, k, r) of their r conditions, 1 or 2.
    """
    r = A.shape[2]
    if r == 1:
        return np.asarray(A[:, :, 0] * g / np.maximum((A ** 2).sum(axis=3), 1e-3))
    At = np.swapaxes(A, 2, 3)
    return np.asarray((At @ np.linalg.solve(A @ At + 1e-6 * np.eye(r), g[..., None]))[..., 0])


def _fitted(batch: Batch, view: View) -> tuple[Batch, Array]:
    """Return the batch with features cut to the view, and the shares (n,) that remain."""
    anchors = batch.anchors[:, None]
    offset = batch.points - anchors
    outward = np.maximum(offset @ view.normals.T, 1e-9)
    room = view.offsets - anchors @ view.normals.T
    share = np.clip((room / outward).min(axis=(1, 2)), 0.0, 1.0)
    batch = batch.moved(anchors + share[:, None, None] * offset)
    obs = batch.problem.observations
    fewer = np.repeat(1 / np.sqrt(np.maximum(share, 1e-3)), len(obs) // len(batch))
    obs = replace(obs, noise=obs.noise * fewer[:, None, None])
    return replace(batch, problem=replace(batch.problem, observations=obs)), share


def _steep(batch: Batch, by_point: Array) -> NDArray[np.bool_]:
    """Return which stations have conditions that are sensitive to moves within the plane."""
    angle = rules.stricter(batch.problem.config).sampling.min_crossing_angle
    good = np.ones(len(batch), dtype=bool)
    for rows in batch.groups:
        A = by_point[:, rows]
        steepness = np.linalg.eigvalsh(A @ np.swapaxes(A, 2, 3))[..., 0].min(axis=1)
        good &= steepness > np.sin(angle) ** 2
    return good


def _facing(batch: Batch, by_point: Array) -> NDArray[np.bool_]:
    """Return which stations see the target from the same side as the template."""
    good = np.ones(len(batch), dtype=bool)
    for rows in batch.groups:  # all conditions of a point: independent of the choice of axes
        size = np.linalg.norm(batch.seen[rows], axis=1)
        along_range = (by_point[:, rows, 1] * batch.seen[rows]).sum(axis=2)
        towards = along_range > rules.SMALLEST_COSINE * size
        good &= (towards | (size <= rules.SMALLEST_COSINE)).all(axis=1)
    return good


def _recognised(batch: Batch) -> NDArray[np.bool_]:
    """Return which stations would be labelled like the template."""
    problem, estimate = batch.problem, batch.estimate
    p = problem.points_in_base(estimate.X)
    labelled = problem.method.relabel(problem.observations, p, estimate.target,
                                               rules.stricter(problem.config))
    same = labelled.kind == problem.observations.kind
    return np.asarray(same.reshape(len(batch), -1).all(axis=1))
