# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What a target has to say, and what all targets share.

A new target is a subclass in one file: the features of a profile that show it, the conditions of
their points in the target's frame, which moves and measures of it are unknown, and a start.
"""
from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint, FaceLine, Feature, Sample
from handeye_ros.estimation.blocks import Blocks
from handeye_ros.estimation.problem import Conditions, Linear, Observations, Target
from handeye_ros.targets import blocks
from handeye_ros.targets.common import (
    add_face,
    edge_noise,
    ObservationRows,
    out_of_face,
    SOURCES,
)
import numpy as np
from numpy.typing import NDArray


class ProfileTarget(Target):
    """
    A target that single profiles show.

    features(points (n, 2), config): what a profile shows of it; raises FeatureError.
    """

    features: ClassVar[staticmethod[[Array, Config], tuple[Feature, ...]]]

    def extract(self, points: Array, config: Config) -> tuple[Feature, ...]:
        """Return the features of one profile (n, 2); raises FeatureError without them."""
        return type(self).features(points, config)

    def observe(self, samples: Sequence[Sample]) -> Observations:
        """Return the conditions of the features of samples; labels are assigned later."""
        rows = ObservationRows()
        for station, sample in enumerate(samples):
            for i, feature in enumerate(sample.features):
                self.add(rows, station, feature, i)
        return rows.observations()

    @abstractmethod
    def add(self, rows: ObservationRows, station: int, feature: Feature, number: int) -> None:
        """Append the conditions of a feature, number: its index in the sample."""


class FaceTarget(ProfileTarget):
    """
    A target of faces and edges: a pose, followed by measures in its state (..., 16 + j).

    moves: which of x y z rx ry rz, along and about its own axes, are parameters; the others leave
    it the same. The measures are parameters after them. edge_kinds: of the conditions of one edge
    point; faces: how many lines one view of the target has; many: whether a profile may show
    several surfaces, or pairs of them, of which one is the target.
    """

    moves: ClassVar[Sequence[int]]
    edge_kinds: tuple[int, ...] = ()
    faces = 1
    many = False

    def add(self, rows: ObservationRows, station: int, feature: Feature, number: int) -> None:
        """Append the conditions of a face line or an edge point."""
        if isinstance(feature, FaceLine):
            add_face(rows, station, feature, SOURCES * number, number % self.faces)
        elif isinstance(feature, EdgePoint):
            for kind in self.edge_kinds:
                rows.add(station, self.edge_place(feature), kind, edge_noise(feature),
                         SOURCES * number, feature)

    def edge_place(self, edge: EdgePoint) -> Array:
        """Return the point (2,) that is on the edge."""
        return edge.point

    def pieces(self, observations: Observations) -> NDArray[np.intp]:
        """Return the number (m,) of the surface, or pair of surfaces, in its profile."""
        return observations.source // (self.faces * SOURCES)

    def ambiguous(self, observations: Observations) -> bool:
        """Return whether a station shows several surfaces or pairs of them."""
        return self.many and bool(self.pieces(observations).any())

    @abstractmethod
    def on_target(self, local: Array, kind: NDArray[np.intp], measures: Array
                  ) -> tuple[Array, Array, Array]:
        """
        Return the conditions g (..., m) of points (..., m, 3) in the target's frame.

        And their derivatives by the points, (..., m, 3), and by the measures, (..., m, j).
        """

    def axes(self, R: Array) -> Array:
        """Return the axes (..., 3, 3), in the columns, of the moves of a target turned by R."""
        return R

    def conditions(self, p: Array, kind: NDArray[np.intp], state: Array, config: Config
                   ) -> Conditions:
        """Return the conditions of points (..., m, 3) in base for targets (..., 16 + j)."""
        T = state[..., :16].reshape(*state.shape[:-1], 4, 4)
        R, offset = T[..., :3, :3], p - T[..., None, :3, 3]
        g, by_local, by_measures = self.on_target(offset @ R, kind, state[..., 16:])
        dg_dp, axes = by_local @ np.swapaxes(R, -1, -2), self.axes(R)
        by_pose = np.concatenate([-dg_dp @ axes, -se3.cross(offset, dg_dp) @ axes], axis=-1)
        return Conditions(g, dg_dp, np.concatenate(
            [by_pose[..., list(self.moves)], by_measures], axis=-1))

    def retract(self, state: Array, delta: Array) -> Array:
        """Return targets (..., 16 + j) after a step of moves and measures."""
        T = state[..., :16].reshape(*state.shape[:-1], 4, 4)
        moves, axes = np.zeros((*delta.shape[:-1], 6)), self.axes(T[..., :3, :3])
        moves[..., list(self.moves)] = delta[..., :len(self.moves)]
        step = np.concatenate([np.einsum('...ij,...j->...i', axes, part)
                               for part in (moves[..., :3], moves[..., 3:])], axis=-1)
        pose = se3.perturb(T, step).reshape(*state.shape[:-1], 16)
        return np.concatenate([pose, state[..., 16:] + delta[..., len(self.moves):]], axis=-1)

    def blocks(self, linear: Linear) -> Blocks:
        """Yield the blocks of set-backs, shapes of edges, and flatness of faces."""
        for source in (blocks.setbacks, blocks.edge_shapes, blocks.flatness, blocks.grazing):
            yield from source(linear)

    def feature_errors(self, linear: Linear) -> Array:
        """Return the derivatives (m, 1) by independent set-backs of edge points, in sigmas."""
        return out_of_face(linear)[:, None] * linear.problem.config.target.setback_std
