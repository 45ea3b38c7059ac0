"""Nuisance parameters common to targets: set-back of faces, shapes of edges, flatness."""
from __future__ import annotations

from collections.abc import Iterable, Iterator

from handeye_ros.data import Array
from handeye_ros.estimation.basis import bent_surface
from handeye_ros.estimation.blocks import Blocks, ParameterBlock
from handeye_ros.estimation.linearise import Linear
from handeye_ros.estimation.model import Nuisances
from handeye_ros.targets.common import edges_of, ENDS, ends_of, out_of_face
import numpy as np

FLATNESS = {2: 0.8, 3: 0.5, 4: 0.3}  # share of the RMS of each degree: the first are the largest

GRAZING = 0.64  # cosine of the incidence below which the range of a face may be wrong
STEEPNESS = np.array([8, 16, 32])  # exponents of the smallest cosine over that of a point


def of_faces_and_edges(first: Linear) -> Blocks:
    """Return the blocks of set-backs, edge shapes, and flatness of faces."""
    every = [source(first) for source in (setbacks, edge_shapes, flatness, grazing)]

    def at(linear: Linear) -> Iterator[ParameterBlock]:
        for blocks in every:
            yield from blocks(linear)
    return at


def setbacks(first: Linear) -> Blocks:
    """Return the blocks of the set-back of faces from their edges, one per kind of end."""
    std = first.problem.config.target.setback_std
    obs = edges_of(first.problem.observations)
    ends, kinds = ends_of(obs), first.problem.method.kinds
    # the visible part of a bevel or a blurred step depends on the tilt
    by_slope = np.column_stack([ends.slope, 2 * ends.slope ** 2])

    def at(linear: Linear) -> Iterator[ParameterBlock]:
        outwards = ends.outwards(linear)
        for (kind, end), rows in ends.parts.items():
            name = f'setback_{kinds[kind]}_{ENDS[end - 1]}'
            yield ParameterBlock(name, np.where(rows, outwards, 0.0)[:, None] * std, std,
                                 report=name)
        for end in sorted({end for _, end in ends.parts}):
            tilted = np.where(obs.end == end, outwards, 0.0)[:, None] * by_slope
            yield ParameterBlock(f'incidence_{ENDS[end - 1]}', tilted * std, std)
    return at if ends.parts else _none


def edge_shapes(first: Linear) -> Blocks:
    """Return the blocks of the deviation of edge shapes from those seen in profiles."""
    obs = edges_of(first.problem.observations)
    ends = ends_of(obs)
    of_kind = {kind: np.any([rows for (k, _), rows in ends.parts.items() if k == kind], axis=0)
               for kind in sorted({kind for kind, _ in ends.parts})}

    def at(linear: Linear) -> Iterator[ParameterBlock]:
        outwards = ends.outwards(linear) * obs.shape
        for kind, rows in of_kind.items():
            # it comes from few points of a curve, and is extrapolated
            yield ParameterBlock(f'shape_{first.problem.method.kinds[kind]}',
                                 np.where(rows, outwards, 0.0)[:, None], 1.0, least=1.0)
    return at if obs.shape.any() else _none


def flatness(first: Linear) -> Blocks:
    """Return the blocks of bowed faces: polynomials over each face, by degree."""
    problem, std = first.problem, first.problem.config.noise.flatness
    if not std:
        return _none
    p = problem.points_in_base(first.estimate.X)
    heights = zip(*(bent_surface(p, problem.observations.kind == i, list(FLATNESS))
                    for i, name in enumerate(problem.method.kinds) if name.startswith('face')),
                  strict=True)
    blocks = [ParameterBlock(f'flatness_{degree}', np.hstack(columns) * (std * share), std * share,
                             report='flatness_error')
              for (degree, share), columns in zip(FLATNESS.items(), heights, strict=False)]
    return lambda linear: blocks


def grazing(first: Linear) -> Blocks:
    """Return the block of the range error of faces seen at grazing incidence."""
    problem, std = first.problem, first.problem.config.noise.distortion
    faces = [i for i, name in enumerate(problem.method.kinds) if name.startswith('face')]
    on_face, points = np.isin(problem.observations.kind, faces), problem.observations.points

    def cosines(linear: Linear) -> Array:
        along = np.abs((linear.by_point * points).sum(axis=1)) / np.linalg.norm(points, axis=1)
        return np.where(on_face, along, 1.0)
    least = cosines(first).min(initial=1.0)

    def at(linear: Linear) -> Iterator[ParameterBlock]:
        cosine = cosines(linear)
        share = np.where(cosine < GRAZING, least / np.maximum(cosine, least), 0.0)
        columns = linear.by_point[:, 1:] * share[:, None] ** STEEPNESS
        yield ParameterBlock('grazing', columns * std, std)
    return at if std and least < GRAZING else _none


def _none(linear: Linear) -> Iterable[ParameterBlock]:
    return ()


def setback_of_each(linear: Linear) -> Array:
    """Return the derivatives (m, 1) by independent set-backs of edge points, in sigmas."""
    return out_of_face(linear)[:, None] * linear.problem.config.target.setback_std


FACES_AND_EDGES = Nuisances(of_faces_and_edges, setback_of_each)
