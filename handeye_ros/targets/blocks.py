# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Nuisance parameters common to targets: set-back of faces, shapes of edges, flatness."""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros.data import Array
from handeye_ros.estimation.basis import bent_surface
from handeye_ros.estimation.blocks import Blocks, ParameterBlock
from handeye_ros.estimation.problem import Linear, Observations
from handeye_ros.targets.common import ENDS, out_of_face
import numpy as np
from numpy.typing import NDArray

FLATNESS = {2: 0.8, 3: 0.5, 4: 0.3}  # share of the RMS of each degree: the first are the largest

GRAZING = 0.64  # cosine of the incidence below which the range of a face may be wrong
STEEPNESS = np.array([8, 16, 32])  # exponents of the smallest cosine over that of a point


@dataclass(frozen=True, eq=False)
class Ends:
    """
    The ends of faces, m observations in all.

    feature: (m,) index of the feature of each observation; parts: for each (kind, way the face
    ends), which observations (m,) these are, kind 0 if an end has several; slope: (m,) of the face
    there, against the line of sight.
    """

    feature: NDArray[np.intp]
    parts: dict[tuple[int, int], NDArray[np.bool_]]
    slope: Array

    def outwards(self, linear: Linear) -> Array:
        """Return derivatives (m,) by outward moves of the ends, of unit length per feature."""
        along = out_of_face(linear)
        length = np.sqrt(np.bincount(self.feature, along ** 2))[self.feature]
        return np.divide(along, length, out=np.zeros(len(along)), where=length > 0)


def ends_of(obs: Observations) -> Ends:
    """Return the ends of faces among observations."""
    source = obs.station * (int(obs.source.max(initial=0)) + 1) + obs.source
    _, feature, count = np.unique(source, return_inverse=True, return_counts=True)
    kind = np.where(count[feature] > 1, 0, obs.kind)  # conditions of one point share its edge
    found = sorted({(int(k), int(e)) for k, e in zip(kind, obs.end, strict=True) if e})
    slope = np.divide(obs.outward[:, 1], np.abs(obs.outward[:, 0]), out=np.zeros(len(obs)),
                      where=obs.outward[:, 0] != 0)
    return Ends(feature, {(k, e): (kind == k) & (obs.end == e) for k, e in found}, slope)


def setbacks(linear: Linear) -> Blocks:
    """Yield the blocks of the set-back of faces from their edges, one per kind of end."""
    std, kinds = linear.problem.config.target.setback_std, linear.problem.target.kinds
    obs = linear.problem.observations
    ends = ends_of(obs)
    outwards = ends.outwards(linear)
    # the visible part of a bevel or a blurred step depends on the tilt
    by_slope = np.column_stack([ends.slope, 2 * ends.slope ** 2])
    for (kind, end), rows in ends.parts.items():
        name = f'setback_{kinds[kind]}_{ENDS[end - 1]}'
        yield ParameterBlock(name, np.where(rows, outwards, 0.0)[:, None] * std, std, report=name)
    for end in sorted({end for _, end in ends.parts}):
        tilted = np.where(obs.end == end, outwards, 0.0)[:, None] * by_slope
        yield ParameterBlock(f'incidence_{ENDS[end - 1]}', tilted * std, std)


def edge_shapes(linear: Linear) -> Blocks:
    """Yield the blocks of the deviation of edge shapes from those seen in profiles."""
    obs = linear.problem.observations
    if not obs.shape.any():
        return
    ends = ends_of(obs)
    outwards = ends.outwards(linear) * obs.shape
    for kind in sorted({kind for kind, _ in ends.parts}):
        rows = np.any([own for (k, _), own in ends.parts.items() if k == kind], axis=0)
        # it comes from few points of a curve, and is extrapolated
        yield ParameterBlock(f'shape_{linear.problem.target.kinds[kind]}',
                             np.where(rows, outwards, 0.0)[:, None], 1.0, least=1.0)


def flatness(linear: Linear) -> Blocks:
    """Yield the blocks of bowed faces: polynomials over each face, by degree."""
    problem, std = linear.problem, linear.problem.config.noise.flatness
    faces = [i for i, name in enumerate(problem.target.kinds) if name.startswith('face')]
    if not std or not faces:
        return
    p = problem.points_in_base(linear.estimate.X)
    heights = zip(*(bent_surface(p, problem.observations.kind == i, list(FLATNESS))
                    for i in faces), strict=True)
    for (degree, share), columns in zip(FLATNESS.items(), heights, strict=True):
        yield ParameterBlock(f'flatness_{degree}', np.hstack(columns) * (std * share), std * share,
                             report='flatness_error')


def grazing(linear: Linear) -> Blocks:
    """Yield the block of the range error of faces seen at grazing incidence."""
    problem, std = linear.problem, linear.problem.config.noise.distortion
    faces = [i for i, name in enumerate(problem.target.kinds) if name.startswith('face')]
    on_face, points = np.isin(problem.observations.kind, faces), problem.observations.points
    along = np.abs((linear.by_point * points).sum(axis=1)) / np.linalg.norm(points, axis=1)
    cosine = np.where(on_face, along, 1.0)
    least = cosine.min(initial=1.0)
    if std and least < GRAZING:
        share = np.where(cosine < GRAZING, least / np.maximum(cosine, least), 0.0)
        columns = linear.by_point[:, 1:] * share[:, None] ** STEEPNESS
        yield ParameterBlock('grazing', columns * std, std)
