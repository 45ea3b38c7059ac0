"""
What may be wrong beside the noise: each doubt is some unknowns with a prior.

With residuals r = J u + K n + e, a doubt gives columns of K, scaled so that its unknowns n are of
unit variance; how large they really were is estimated (see mixed).
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.basis import bending, bent_faces
from handeye_ros.estimation.linearise import Linear, points_in_base, Problem
from handeye_ros.estimation.noise import TURN_LENGTH
import numpy as np

# Share of the RMS of each degree of the polynomials: the first of them are the largest.
DISTORTION = {1: 0.5, 2: 0.5, 3: 0.5, 4: 0.4}
FLATNESS = {2: 0.8, 3: 0.5, 4: 0.3}
# Of the six numbers of a pose, those that a smooth error of the robot changes, and its unit.
SMOOTH = {'robot_position': slice(0, 3), 'robot_rotation': slice(3, 6)}
SMOOTH_UNIT = {'robot_position': 1.0, 'robot_rotation': 1 / TURN_LENGTH}


@dataclass(frozen=True, eq=False)
class ParameterBlock:
    """
    Something that may be wrong.

    columns: (m, k) derivatives of the residuals by taking it out, each unknown in units of its
    prior sigma std (m, rad or 1); parameter: which of the target's it is of, None of none.
    functions: of each column so many unknowns, times the functions of the poses (see Columns).
    least: variance over the configured one that it has at least, whatever the data show.
    """

    name: str
    columns: Array
    std: float
    parameter: int | None = None
    functions: int = 1
    least: float = 0.0

    @property
    def count(self) -> int:
        """Return the number of its unknowns."""
        return int(self.columns.shape[1]) * self.functions


@dataclass(frozen=True, eq=False)
class Deformation:
    """
    In which ways, each of unit size, sensor and target may be bent.

    sensor: by the degrees of DISTORTION, (m, 2, k) at each point; faces: of each face, by the
    degrees of FLATNESS, (m, k).
    """

    sensor: list[Array]
    faces: list[list[Array]]


def tolerances(problem: Problem) -> Array:
    """Return 1 sigma (k,) of the target's parameters that are stated with one, 0 of others."""
    stated = problem.method.tolerances(problem.config)
    return stated if len(stated) else np.zeros(len(problem.method.labels))


def parameter_blocks(problem: Problem, linear: Linear, near: Deformation
                     ) -> tuple[ParameterBlock, ...]:
    """
    Return all that may be wrong at an estimate, the smooth errors of the robot last.

    near: the ways to be bent there.
    """
    found = [*_stated(problem, linear), *_setbacks(problem, linear), *_shapes(problem, linear),
             *_scale(problem, linear), *_sensor(problem, linear, near.sensor),
             *_faces(problem, near.faces), *_robot(problem, linear)]
    return tuple(block for block in found if block.std > 0 and block.columns.any())


def _stated(problem: Problem, linear: Linear) -> Iterator[ParameterBlock]:
    stds = tolerances(problem)
    for i in np.flatnonzero(stds).tolist():
        std = float(stds[i])
        column = linear.jacobian[:, 6 + i:7 + i] * std
        yield ParameterBlock(problem.method.labels[i], column, std, i)


def _setbacks(problem: Problem, linear: Linear) -> Iterator[ParameterBlock]:
    """Yield by how much the faces end short of each edge, for each way in which they end."""
    obs, std, ends = problem.observations, problem.config.target.setback_std, problem.ends
    if not ends.parts:
        return
    outwards = ends.outwards((linear.by_point * obs.outward).sum(axis=1))
    for (kind, end), here in ends.parts.items():
        name = f'setback_{problem.method.kinds[kind]}_{end}'
        yield ParameterBlock(name, np.where(here, outwards, 0.0)[:, None] * std, std)
    # what of a bevel or of a blurred step is seen depends on the tilt
    by_slope = np.column_stack([ends.slope, 2 * ends.slope ** 2])
    for end in sorted({end for _, end in ends.parts}):
        tilted = np.where(obs.end == end, outwards, 0.0)[:, None] * by_slope
        yield ParameterBlock(f'incidence_{end}', tilted * std, std)


def _shapes(problem: Problem, linear: Linear) -> Iterator[ParameterBlock]:
    """Yield by how much the rounding or the bevel of each edge is not as the profiles show it."""
    obs, ends = problem.observations, problem.ends
    if not obs.shape.any():
        return
    outwards = ends.outwards((linear.by_point * obs.outward).sum(axis=1)) * obs.shape
    for kind in sorted({kind for kind, _ in ends.parts}):
        here = np.any([rows for (other, _), rows in ends.parts.items() if other == kind], axis=0)
        name = f'shape_{problem.method.kinds[kind]}'
        # it was told from few points of a curve, whatever that really goes on as
        yield ParameterBlock(name, np.where(here, outwards, 0.0)[:, None], 1.0, least=1.0)


def _scale(problem: Problem, linear: Linear) -> Iterator[ParameterBlock]:
    """Yield the scale of the robot."""
    std, station = problem.config.noise.robot_scale, problem.observations.station
    by_scale = np.einsum('mi,mi->m', linear.by_pose[:, :3], _scaled(problem)[station])
    yield ParameterBlock('scale', by_scale[:, None] * std, std)


def _robot(problem: Problem, linear: Linear) -> Iterator[ParameterBlock]:
    """Yield the smooth errors of the robot's position and of its rotation."""
    size = problem.config.noise.robot_smooth
    for name, axes in SMOOTH.items() if size else ():
        std = size * SMOOTH_UNIT[name]
        yield ParameterBlock(name, linear.by_pose[:, axes] * std, std,
                             functions=problem.smooth.shape[1])


def _scaled(problem: Problem) -> Array:
    """Return by how much (n, 3) the positions of the robot shrink when its scale grows."""
    poses = problem.poses
    if problem.config.calibration_type != 'eye_in_hand':
        poses = se3.inverse(poses)
    return np.asarray(poses[:, :3, 3].mean(axis=0) - poses[:, :3, 3])


def pose_errors(problem: Problem, found: Sequence[ParameterBlock], values: Array) -> Array:
    """
    Return the errors (n, 6) of the poses that doubts found by so much stand for.

    values: (q,) of the unknowns of all doubts, one after the other, in their present sigmas; or
    (n, q), of each pose its own.
    """
    n = len(problem.poses)
    errors, values = np.zeros((n, 6)), np.broadcast_to(values, (n, values.shape[-1]))
    first = 0
    for block in found:
        last = first + block.count
        if block.name == 'scale':
            errors[:, :3] += _scaled(problem) * (values[:, first, None] * block.std)
        elif block.name in SMOOTH:
            by_axis = values[:, first:last].reshape(n, 3, -1)
            errors[:, SMOOTH[block.name]] += block.std * np.einsum(
                'nak,nk->na', by_axis, problem.smooth)
        first = last
    return errors


def _sensor(problem: Problem, linear: Linear, fields: list[Array]) -> Iterator[ParameterBlock]:
    std = problem.config.noise.distortion
    if not std:
        return
    for (degree, share), field in zip(DISTORTION.items(), fields, strict=True):
        by_x, by_z = (linear.by_point * (std * share)).T[:, :, None]
        columns = by_x * field[:, 0] + by_z * field[:, 1]
        yield ParameterBlock(f'distortion_{degree}', columns, std * share)


def deformation(linear: Linear) -> Deformation:
    """Return in which ways sensor and target may be bent, near an estimate."""
    problem = linear.problem
    noise, kind = problem.config.noise, problem.observations.kind
    sensor = bending(points_on_target(linear), list(DISTORTION)) if noise.distortion else []
    if not noise.flatness:
        return Deformation(sensor, [])
    p = points_in_base(problem, linear.estimate.X)
    return Deformation(sensor, [bent_faces(p, kind == i, list(FLATNESS))
                         for i, name in enumerate(problem.method.kinds)
                         if name.startswith('face')])


def points_on_target(linear: Linear) -> Array:
    """
    Return the points (m, 2) of the sensor's plane where their conditions hold.

    The field at the points as measured has their errors in it: of many points least squares
    would then find that all lengths are nothing, with which the errors vanish, too.
    """
    g = linear.by_point
    square = (g ** 2).sum(axis=1)
    share = np.divide(linear.residuals, square, out=np.zeros(len(g)), where=square > 0)
    return np.asarray(linear.problem.observations.points - g * share[:, None])


def _faces(problem: Problem, faces: list[list[Array]]) -> Iterator[ParameterBlock]:
    std = problem.config.noise.flatness
    for (degree, share), *columns in zip(FLATNESS.items(), *faces, strict=True):
        if columns:
            size = std * share
            yield ParameterBlock(f'flatness_{degree}', np.hstack(columns) * size, size)
