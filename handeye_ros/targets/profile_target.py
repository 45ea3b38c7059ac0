# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What targets share beyond their geometry (estimation/target.py).

A new target is a subclass of ProfileTarget in a file of its own, listed in __init__.py; plane.py
is the smallest. It states

- name, extract: the features of one profile, or FeatureError (profiles/), and required_features:
  the types of those that are always among them
- kinds, and normals or local_conditions: what vanishes for the points of features in its frame
- parameter_names, pose_axes, stated_values: what of its pose and measures is unknown, or known
- starts: estimates to search from (starts.py), and reassign where a profile may show other things
- describe: what was estimated, as plain values
- where they differ from those of ProfileTarget and Target: edge_kinds, unassigned_edge_kinds,
  min_samples, unstated_measure, loosened_lengths, face_count, several_in_view, lost_with_one_axis
- edge_place, where another point than the edge point is on the edge
- axes, where its moves are not along and about its own axes
- retract and measures, where its parameters are not the entries of its state
- raw_points, where its features hold the measured points that their means stand for
- half_turn_misfit, where half a turn about another place than a point may change its views least
- alike_views_in_words, where views that are too much alike leave something undetermined
- describe_strays, where it can say how far from its own the unused edges lie
- blocks and point_errors, where it has other systematic errors than those of faces

Here are its observations, and the systematic errors that targets of faces have in common: set-back
of faces, shapes of edges, flatness, range at grazing incidence.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, EdgePoint, ENDINGS, FaceLine, Feature, Sample
from handeye_ros.estimation.basis import bent_surface
from handeye_ros.estimation.blocks import Blocks, ParameterBlock
from handeye_ros.estimation.problem import Linearisation, Observations, UNUSED
from handeye_ros.estimation.target import Target
from handeye_ros.targets.starts import is_of_nearest_candidate
import numpy as np

FACE = 0  # the kind of the conditions on the face, in every target that has only one
# share of the RMS of each degree: the first are the largest
FLATNESS_SHARES = {2: 0.8, 3: 0.5, 4: 0.3}

GRAZING, FLATNESS_ERROR = 'grazing', 'flatness_error'
GRAZING_COSINE = 0.64  # cosine of the incidence below which the range of a face may be wrong
# exponents of the smallest cosine over that of a point
STEEPNESS_EXPONENTS = np.array([8, 16, 32])


def observations_at(station: int, points: Array, kind: int, error_root: Array, feature: int = 0,
                    edge: EdgePoint | None = None) -> Observations:
    """
    Return a condition for each of points (k, 2), with roots (k, 2, 2); see Observations.

    edge: that the points are on, or None.
    """
    n = len(points)
    ending, outward, shape_std = (
        (1 + ENDINGS.index(edge.ending), edge.direction, edge.shape_std) if edge else
        (0, np.zeros(2), 0.0))
    return Observations(np.full(n, station), points, np.full(n, kind), error_root,
                        np.full(n, feature), np.full(n, ending), np.tile(outward, (n, 1)),
                        np.full(n, shape_std))


NO_OBSERVATIONS = observations_at(0, np.empty((0, 2)), 0, np.empty((0, 2, 2)))


def edge_error_root(edge: EdgePoint) -> Array:
    """Return the root (2, 2) of an edge point's covariance."""
    across = np.array([-edge.direction[1], edge.direction[0]])
    return np.column_stack([edge.direction * edge.std, across * edge.std_across])


def _mean_points(feature: FaceLine | Arc) -> tuple[Array, Array]:
    """Return the mean points (k, 2) of a line or an arc, and 1 sigma across it as vectors."""
    if isinstance(feature, Arc):
        radial = feature.points - feature.centre
        return feature.points, (feature.std / np.linalg.norm(radial, axis=1))[:, None] * radial
    points, std = feature.points, feature.points_std
    if not len(points):  # only the line is known: two decorrelated points
        points = feature.centre + np.outer([-1.0, 1.0], feature.spread * feature.direction)
        std = np.full(2, feature.std * 2 ** 0.5)
    return points, np.outer(std, [-feature.direction[1], feature.direction[0]])


def xyz(point: Array) -> dict[str, float]:
    """Return a point (3,) as plain values."""
    return dict(zip('xyz', map(float, point), strict=True))


class ProfileTarget(Target):
    """
    A target that profiles show by faces, arcs and edge points.

    extract(points (n, 2), config): the features of one profile; raises FeatureError without them.

    required_features: types of the features that extract gives at least, one for each
    unassigned_edge_kinds: the kinds of the conditions that one edge point gives, before it is
        reassigned
    lost_with_one_axis: what rotations about one axis alone leave undetermined, in words
    """

    extract: ClassVar[staticmethod[[Array, Config], tuple[Feature, ...]]]
    required_features: ClassVar[Sequence[type[Feature]]] = (FaceLine,)
    unassigned_edge_kinds: tuple[int, ...] = ()
    lost_with_one_axis = 'the position along it is free'

    def observe(self, samples: Sequence[Sample]) -> Observations:
        """Return the conditions of the features of samples; kinds are assigned later."""
        parts = [NO_OBSERVATIONS]
        for station, sample in enumerate(samples):
            for number, feature in enumerate(sample.features):
                if isinstance(feature, EdgePoint):
                    for kind in self.unassigned_edge_kinds:
                        parts.append(observations_at(
                            station, self.edge_place(feature)[None], kind,
                            edge_error_root(feature)[None], number, feature))
                else:
                    points, across = _mean_points(feature)
                    parts.append(observations_at(
                        station, points, number % self.face_count,
                        np.stack([across, np.zeros_like(across)], axis=-1), number))
        return Observations.concatenated(parts)

    def edge_place(self, edge: EdgePoint) -> Array:
        """Return the point (2,) that is on the edge."""
        return edge.point

    def reassign(self, observations: Observations, p: Array, state: Array, config: Config
                 ) -> Observations:
        """Return the observations with one candidate per station: the first of the near ones."""
        if not self.shows_several(observations):
            return observations
        squares = self.conditions(p, observations.kind, state, config).g ** 2
        nearest = is_of_nearest_candidate(observations, self.candidates(observations), squares)
        return replace(observations, kind=np.where(nearest, observations.kind, UNUSED))

    def blocks(self, linear: Linearisation) -> Blocks:
        """Yield the blocks of the ends of faces, of their flatness, and of grazing light."""
        for source in (ends_of_faces, flatness, grazing):
            yield from source(linear)

    def point_errors(self, linear: Linearisation) -> Array:
        """Return the derivatives (m, 1) by independent set-backs of edge points, in sigmas."""
        return out_of_face(linear)[:, None] * linear.problem.config.target.setback_std


def out_of_face(linear: Linearisation) -> Array:
    """Return derivatives (m,) of residuals by moves of edge points outwards from their faces."""
    outward = linear.problem.observations.outward
    return np.asarray((linear.wrt_point * outward).sum(axis=1))


def ends_of_faces(linear: Linearisation) -> Blocks:
    """
    Yield the blocks of the ends of faces: set-back, its change with the tilt, and shape.

    The set-back is one per kind and way of ending, of the first kind for several conditions; the
    shape is how far the true one deviates from that seen in profiles.
    """
    obs, kinds = linear.problem.observations, linear.problem.target.kinds
    std, end = linear.problem.config.target.setback_std, obs.ending > 0
    _, first, feature = np.unique(obs.station * (1 + obs.feature.max(initial=0)) + obs.feature,
                                  return_index=True, return_inverse=True)
    kind = obs.kind[first][feature]  # conditions of one point share its edge
    # derivatives by outward moves, scaled to unit length per feature
    by_move = out_of_face(linear)
    length = np.sqrt(np.bincount(feature, by_move ** 2))[feature]
    outwards = np.divide(by_move, length, out=np.zeros(len(by_move)), where=length > 0)
    for k, e in sorted({*zip(kind[end].tolist(), obs.ending[end].tolist(), strict=True)}):
        rows = (kind == k) & (obs.ending == e)
        name = f'setback_{kinds[k]}_{ENDINGS[e - 1]}'
        columns = np.where(rows, outwards, 0.0)[:, None] * std
        yield ParameterBlock(name, columns, std, reported_as=name)
    # the visible part of a bevel or a blurred step depends on the tilt
    slope = np.divide(obs.outward[:, 1], np.abs(obs.outward[:, 0]), out=np.zeros(len(obs)),
                      where=obs.outward[:, 0] != 0)
    by_slope = np.column_stack([slope, 2 * slope ** 2])
    for e in np.unique(obs.ending[end]).tolist():
        tilted = np.where(obs.ending == e, outwards, 0.0)[:, None] * by_slope
        yield ParameterBlock(f'incidence_{ENDINGS[e - 1]}', tilted * std, std)
    for k in np.unique(kind[end]).tolist():
        # it comes from few points of a curve, and is extrapolated
        by_shape = np.where(end & (kind == k), outwards * obs.shape_std, 0.0)
        yield ParameterBlock(f'shape_{kinds[k]}', by_shape[:, None], 1.0, least_tau_squared=1.0)


def face_kinds(target: Target) -> list[int]:
    """Return the kinds of conditions on a face of a target."""
    return [i for i, name in enumerate(target.kinds) if name.startswith('face')]


def flatness(linear: Linearisation) -> Blocks:
    """Yield the blocks of bowed faces: polynomials over each face, by degree."""
    problem, std = linear.problem, linear.problem.config.noise.flatness
    faces = face_kinds(problem.target)
    if not std or not faces:
        return
    p = problem.points_in_base(linear.estimate.X)
    heights = zip(*(bent_surface(p, problem.observations.kind == i, list(FLATNESS_SHARES))
                    for i in faces), strict=True)
    for (degree, share), columns in zip(FLATNESS_SHARES.items(), heights, strict=True):
        yield ParameterBlock(f'flatness_{degree}', np.hstack(columns) * (std * share), std * share,
                             reported_as=FLATNESS_ERROR)


def grazing(linear: Linearisation) -> Blocks:
    """Yield the block of the range error of faces seen at grazing incidence."""
    problem, std = linear.problem, linear.problem.config.noise.distortion
    points = problem.observations.points
    on_face = np.isin(problem.observations.kind, face_kinds(problem.target))
    to_ray = np.abs((linear.wrt_point * points).sum(axis=1)) / np.linalg.norm(points, axis=1)
    cosine = np.where(on_face, to_ray, 1.0)
    least = cosine.min(initial=1.0)
    if std and least < GRAZING_COSINE:
        share = np.where(cosine < GRAZING_COSINE, least / np.maximum(cosine, least), 0.0)
        columns = linear.wrt_point[:, 1:] * share[:, None] ** STEEPNESS_EXPONENTS
        yield ParameterBlock(GRAZING, columns * std, std)
