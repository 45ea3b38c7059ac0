# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Blocks of nuisance parameters: systematic errors beside the noise (docs/estimator.md, section 2).

With residuals r + J xi + sum of K_b n_b = e, a block gives the columns K_b of its parameters, each
with a normal prior about 0. How wide that prior is, tau, is estimated (see noise).

A new block is one more source: a function that yields blocks for a linearised problem.
BLOCK_SOURCES holds the sources of all targets, Target.blocks those of one. Parameters that the
poses depend on (pose parameters) belong to the problem instead, as a PoseModel:

    def poses_and_twists(pose_parameters):  # (k,), so far 0
        times = stamps + pose_parameters[0]
        return interpolated(times), velocities(times)[:, :, None]

    offset = PoseModel(poses_and_twists, names=('time_offset',), stds=(0.05,),
                       stations=np.arange(len(stamps)))
    problem = Problem(target, poses, observations, config, offset)
    problem = problem.with_pose_parameters(np.zeros(1))
    solution = refined_solution(robust_solution(problem, rng, start=start))
    solution.problem.pose_parameters, solution.problem.poses  # as estimated

With eye_on_base, a PoseModel also gives T_base_flange, not the inverted poses.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from handeye_ros.data import Array, ROBOT_POSITION_ERROR
from handeye_ros.estimation.basis import (
    BEND_OF_S,
    bent_line,
    distortion_fields,
    grid_over,
    line_span,
)
from handeye_ros.estimation.best_fit import field_motions, motions_by_poses, plane_motions
from handeye_ros.estimation.noise import SMOOTH_UNITS
from handeye_ros.estimation.problem import Linearisation, Problem
import numpy as np

# names that others ask for
ROBOT_SCALE, ROBOT_SMOOTH, SENSOR_SCALE = 'robot_scale', 'robot_smooth', 'sensor_scale'
LINE_BEND, DISTORTION_ERROR = 'line_bend', 'distortion_error'
DISTORTION_SHARES = {1: 0.5, 2: 0.5, 3: 0.5, 4: 0.4}  # RMS by degree, over noise.distortion
DEGREES = list(DISTORTION_SHARES)
SMOOTH_AXES = np.diag(SMOOTH_UNITS)  # of smooth errors of the robot


@dataclass(frozen=True, eq=False)
class ParameterBlock:
    """
    Nuisance parameters with one prior, at an estimate.

    columns: (m, k) K_b in (2), derivatives of the residuals by the parameters in prior sigmas
    std: the configured prior sigma (m, rad, s or 1)
    twists: (n, 6, k) derivatives of the poses by the parameters (not in sigmas), as in
        Linearisation.wrt_pose; None: they do not change
    best_fit(linear): (6, k) derivatives of the transform that maps points best, (9); None: 0
    target_parameter_index: index of the target's parameter that the block is; None: of none
    pose_parameter_index: index of the pose parameter that it is; None: of none
    value: (1,) of that parameter in the estimate it is linearised at, less the stated
    least_tau_squared, largest_tau_squared: bounds of tau^2
    reported_as: key in the answer, '' for none
    origin: added to the reported value of one parameter
    """

    name: str
    columns: Array
    std: float
    twists: Array | None = None
    best_fit: Callable[[Linearisation], Array] | None = None
    target_parameter_index: int | None = None
    pose_parameter_index: int | None = None
    value: Array | None = None
    least_tau_squared: float = 0.0
    largest_tau_squared: float = 400.0  # 20 times the sigma
    reported_as: str = ''
    origin: float = 0.0

    @property
    def count(self) -> int:
        """Return the number of its parameters."""
        return int(self.columns.shape[1])


Blocks = Iterable[ParameterBlock]
BlockSource = Callable[[Linearisation], Blocks]
"""A function that gives blocks at an estimate."""


def blocks_at(linear: Linearisation) -> tuple[ParameterBlock, ...]:
    """Return all blocks at an estimate."""
    model = linear.problem.pose_model
    sources: list[BlockSource] = [linear.problem.target.blocks]
    sources += [model.blocks] if model and model.blocks else []
    return tuple(block for source in (*sources, *BLOCK_SOURCES) for block in source(linear)
                 if block.std > 0 and block.columns.any())


def stated_measures(linear: Linearisation) -> Blocks:
    """Yield the blocks of the target's stated measures."""
    target, state = linear.problem.target, linear.estimate.state
    names = target.parameter_names
    for name, (stated, std) in target.stated_values(linear.problem.config).items():
        i = names.index(name)
        measure = np.array([target.measures(state).get(name, stated)])
        yield ParameterBlock(name, linear.jacobian[:, 6 + i:7 + i] * std, std,
                             target_parameter_index=i, value=measure - stated,
                             largest_tau_squared=1e8)  # a stated measure may be plainly wrong


def scale_twists(problem: Problem) -> Array:
    """Return the corrections (n, 6, 1) of the poses by one scale of all lengths of the robot."""
    position = problem.robot_poses[:, :3, 3]
    twists = np.zeros((len(position), 6, 1))
    twists[:, :3, 0] = position.mean(axis=0) - position
    return twists


def robot_scale(linear: Linearisation) -> Blocks:
    """Yield the block of one scale error of all lengths of the robot."""
    std, twists = linear.problem.config.noise.robot_scale, scale_twists(linear.problem)
    yield ParameterBlock(ROBOT_SCALE, linear.wrt_twists(twists) * std, std, twists,
                         reported_as='scale', origin=1.0)


def wrt_smooth(wrt_pose: Array, basis: Array, axes: Array = SMOOTH_AXES) -> Array:
    """
    Return derivatives (m, a k) by a smooth error of the robot, of unit size.

    wrt_pose: (m, 6) by pose errors; basis: (m, k) the basis functions at the pose of each; axes:
    (6, a) the errors that each of them makes.
    """
    derivatives = (wrt_pose @ axes)[:, :, None] * basis[:, None]
    return np.asarray(derivatives.reshape(len(wrt_pose), -1))


def smooth_errors(name: str, linear: Linearisation, basis: Array, std: float,
                  axes: Array = SMOOTH_AXES,
                  best_fit: Callable[[Linearisation], Array] | None = None, reported_as: str = ''
                  ) -> ParameterBlock:
    """
    Return the block of smooth errors of the poses, one parameter for each axis and function.

    basis: (n, k) the functions at the poses; axes: see wrt_smooth; std: of each error (m).
    """
    columns = wrt_smooth(linear.wrt_pose, basis[linear.problem.observations.station], axes)
    twists = np.einsum('xa,nk->nxak', axes, basis).reshape(len(basis), 6, -1)
    return ParameterBlock(name, columns * std, std, twists, best_fit, reported_as=reported_as)


def robot_smooth(linear: Linearisation) -> Blocks:
    """Yield the block of the robot's smooth errors, of position and rotation."""
    if std := linear.problem.config.noise.robot_smooth:
        yield smooth_errors(ROBOT_SMOOTH, linear, linear.problem.smooth_error_basis, std,
                            best_fit=_motions_of_smooth, reported_as=ROBOT_POSITION_ERROR)


def _motions_of_smooth(linear: Linearisation) -> Array:
    """Return best-fit motions (6, k) by the robot's smooth errors, of unit size; see best_fit."""
    problem, field = linear.problem, grid_over(linear.problem.observations.points, (-1, 0, 1))
    motions = SMOOTH_UNITS * motions_by_poses(
        problem.poses, linear.estimate.X, field, problem.config.in_hand)
    return np.asarray(np.einsum('xna,nk->xak', motions, problem.smooth_error_basis).reshape(6, -1))


def points_on_target(linear: Linearisation) -> Array:
    """
    Return the points (m, 2) of the sensor plane, moved to where their conditions hold.

    With the errors of the measured points in its columns, least squares would shrink all lengths
    (2,000 stations of a ball: by 0.4 %) and find a distortion that is none.
    """
    gradient = linear.wrt_point
    square = (gradient ** 2).sum(axis=1)
    share = np.divide(linear.residuals, square, out=np.zeros(len(square)), where=square > 0)
    return np.asarray(linear.problem.observations.points - gradient * share[:, None])


def sensor_scale(linear: Linearisation) -> Blocks:
    """Yield the block of one scale error of the sensor, nearly collinear with the robot's."""
    std, gradient = 0.3 * linear.problem.config.noise.robot_scale, linear.wrt_point
    points = points_on_target(linear)
    stretched = (gradient * (points - points.mean(axis=0))).sum(axis=1)
    yield ParameterBlock(SENSOR_SCALE, stretched[:, None] * std, std)


def sensor_distortion(linear: Linearisation) -> Blocks:
    """Yield the blocks of the sensor's distortion: polynomials in its plane, one per degree."""
    distortion = linear.problem.config.noise.distortion
    fields = distortion_fields(points_on_target(linear), DEGREES) if distortion else []
    for i, field in enumerate(fields):
        std = distortion * DISTORTION_SHARES[DEGREES[i]]
        wrt_x, wrt_z = (linear.wrt_point * std).T[:, :, None]
        yield ParameterBlock(
            f'distortion_{DEGREES[i]}', wrt_x * field[:, 0] + wrt_z * field[:, 1], std,
            best_fit=partial(_motions_of_degree, i), reported_as=DISTORTION_ERROR)


def _motions_of_degree(i: int, linear: Linearisation) -> Array:
    """Return best-fit motions (6, k) by the distortion of one degree, of unit size."""
    motions = field_motions(linear.problem.observations.points, DEGREES)
    return np.asarray(plane_motions(linear.estimate.X) @ motions[i])


def line_bend(linear: Linearisation) -> Blocks:
    """Yield the block of a light plane that is bent: its points are not at y = 0."""
    std = linear.problem.config.noise.line_bend
    across = linear.jacobian[:, :3] @ linear.estimate.X[:3, 1]
    columns = across[:, None] * bent_line(linear.problem.observations.points) * std
    yield ParameterBlock(LINE_BEND, columns, std, best_fit=_motion_of_bend, reported_as=LINE_BEND)


def _motion_of_bend(linear: Linearisation) -> Array:
    """
    Return the motion (6, 3) from the plane that fits best to the one that touches the middle.

    The latter is the light plane of a data sheet.
    """
    middle, half = line_span(linear.problem.observations.points)
    _, y, z = linear.estimate.X[:3, :3].T
    slope = 3 / 5 * BEND_OF_S / half
    motion = np.zeros((6, 3))
    motion[:3, 0] = -y / 3
    motion[:3, 2], motion[3:, 2] = slope * middle * y, -slope * z  # a turn about the middle
    return motion


def pose_parameters(linear: Linearisation) -> Blocks:
    """Yield the blocks of the parameters in the problem's pose model, such as a time offset."""
    problem, model = linear.problem, linear.problem.pose_model
    if model is None:
        return
    for k, (name, std) in enumerate(zip(model.names, model.stds, strict=True)):
        twists = problem.pose_twists[:, :, [k]]
        yield ParameterBlock(name, linear.wrt_twists(twists) * std, std, twists,
                             pose_parameter_index=k,
                             value=problem.pose_parameters[[k]],
                             least_tau_squared=model.least_tau_squared, reported_as=name)


def blocks_with_columns(blocks: Sequence[ParameterBlock], first: int = 0
                        ) -> Iterator[tuple[ParameterBlock, slice]]:
    """
    Yield each block with the columns of its parameters among those of all blocks.

    first: the column at which the first block begins.
    """
    for block in blocks:
        yield block, slice(first, first + block.count)
        first += block.count


BLOCK_SOURCES: tuple[BlockSource, ...] = (
    stated_measures, robot_scale, sensor_scale, sensor_distortion, line_bend, pose_parameters,
    robot_smooth)
