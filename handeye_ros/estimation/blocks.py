"""
Blocks of nuisance parameters: systematic errors beside the noise (docs/estimator.md, section 2).

With residuals r + J xi + sum of K_b n_b = e, a block gives the columns K_b of its parameters, each
with a normal prior about 0. The scale of that prior is estimated (see noise).

A new block is one more source: a function that takes the problem linearised at the first estimate
and returns a function that gives the blocks at a later one. SOURCES holds the sources of all
targets, Method.nuisances those of one. Parameters that the poses depend on (a time offset, the
joints of the robot) belong to the problem instead, as a PoseModel:

    def poses_and_twists(values):  # (k,), so far 0
        return interpolated(stamps + values[0]), velocities(stamps + values[0])[:, :, None]

    offset = PoseModel(poses_and_twists, names=('time_offset',), counts=(1,), stds=(0.05,))
    solution = map_solution(Problem(method, poses, observations, config, offset), start)
    solution.problem.pose_values, solution.problem.poses  # as estimated

With eye_on_base, a PoseModel also gives T_base_flange, not the inverted poses.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial

from handeye_ros.data import Array
from handeye_ros.estimation.basis import (
    bending,
    bent_line,
    box,
    field_motions,
    motions_by_poses,
    of_mount,
)
from handeye_ros.estimation.linearise import Linear, Problem
from handeye_ros.estimation.model import Estimate
from handeye_ros.estimation.noise import TURN_LENGTH
import numpy as np

LINE_BEND = 'line_bend'
# RMS of the polynomials of each degree over noise.distortion.
DISTORTION = {1: 0.5, 2: 0.5, 3: 0.5, 4: 0.4}

Retraction = Callable[[Problem, Estimate, Array], tuple[Problem, Estimate]]


@dataclass(frozen=True, eq=False)
class ParameterBlock:
    """
    Nuisance parameters with one prior, at an estimate.

    columns: (m, k) derivatives of the residuals by the parameters, in units of the prior sigma std
    (m, rad, s or 1). functions: (n, f) at the poses: each column then stands for f parameters, one
    for each function. twists: (n, 6, k) change of the poses by the parameters (not in sigmas), as
    in Linear.by_pose; None: no change. best_fit(linear): (6, k * f) derivatives of the best-fit
    transform.
    retract(problem, estimate, change (k,)): both with the parameters changed; None if the
    parameters only correct the residuals. parameter: index of the target's parameter, or None.
    least, largest: bounds of the variance over the configured one. report: key in the answer, ''
    for none; origin: added to the reported value of one parameter.
    """

    name: str
    columns: Array
    std: float
    functions: Array | None = None
    twists: Array | None = None
    best_fit: Callable[[Linear], Array] | None = None
    retract: Retraction | None = None
    parameter: int | None = None
    least: float = 0.0
    largest: float = 400.0  # 20 times the sigma
    report: str = ''
    origin: float = 0.0

    @property
    def count(self) -> int:
        """Return the number of its parameters."""
        k = int(self.columns.shape[1])
        return k if self.functions is None else k * int(self.functions.shape[1])


Blocks = Callable[[Linear], Iterable[ParameterBlock]]
"""The blocks at an estimate."""
Source = Callable[[Linear], Blocks]
"""A function that prepares the blocks at the first estimate."""


def prepared(first: Linear) -> Callable[[Linear], tuple[ParameterBlock, ...]]:
    """
    Return the function that gives all blocks at an estimate; bases are fixed at the first one.

    Blocks with functions of the poses come last.
    """
    own = (first.problem.method.nuisances, first.problem.pose_model)
    sources = [each.blocks for each in own if each and each.blocks]
    every = [source(first) for source in (*sources, *SOURCES)]

    def at(linear: Linear) -> tuple[ParameterBlock, ...]:
        return tuple(block for blocks in every for block in blocks(linear)
                     if block.std > 0 and block.columns.any())
    return at


def stated_measures(first: Linear) -> Blocks:
    """Return the blocks of the target's stated measures."""
    method, stds = first.problem.method, first.problem.tolerances

    def retract_by(i: int) -> Retraction:
        def retract(problem: Problem, estimate: Estimate, change: Array
                    ) -> tuple[Problem, Estimate]:
            delta = np.zeros(len(method.labels))
            delta[i] = change[0]
            return problem, Estimate(estimate.X, method.geometry.retract(estimate.target, delta))
        return retract

    def at(linear: Linear) -> Iterator[ParameterBlock]:
        for i in np.flatnonzero(stds).tolist():
            std = float(stds[i])
            yield ParameterBlock(method.labels[i], linear.jacobian[:, 6 + i:7 + i] * std, std,
                                 retract=retract_by(i), parameter=i,
                                 largest=1e8)  # a stated measure may be plainly wrong
    return at


def robot_scale(first: Linear) -> Blocks:
    """Return the block of one scale error of all lengths of the robot."""
    problem, std = first.problem, first.problem.config.noise.robot_scale
    poses = problem.robot_poses
    twists = np.zeros((len(poses), 6, 1))
    twists[:, :3, 0] = poses[:, :3, 3].mean(axis=0) - poses[:, :3, 3]

    def at(linear: Linear) -> Iterator[ParameterBlock]:
        yield ParameterBlock('scale', linear.by_twists(twists) * std, std, twists=twists,
                             report='scale', origin=1.0)
    return at


def robot_smooth(first: Linear) -> Blocks:
    """Return the block of the robot's smooth errors, of position and rotation."""
    size = first.problem.config.noise.robot_smooth
    axes = np.diag(np.repeat([1.0, 1 / TURN_LENGTH], 3))

    def best_fit(linear: Linear) -> Array:
        problem, field = linear.problem, box(linear.points_on_target, (-1, 0, 1))
        motions = motions_by_poses(problem.poses, linear.estimate.X, field, problem.in_hand)
        return np.asarray(np.einsum('xna,nk->xak', motions @ axes, problem.smooth).reshape(6, -1))

    def at(linear: Linear) -> Iterator[ParameterBlock]:
        twists = np.broadcast_to(axes, (len(linear.problem.poses), 6, 6))
        yield ParameterBlock('robot_smooth', linear.by_pose @ axes * size, size,
                             linear.problem.smooth, twists, best_fit,
                             report='robot_position_error')
    return at if size else _none


def sensor_scale(first: Linear) -> Blocks:
    """Return the block of one scale error of the sensor, nearly collinear with the robot's."""
    std = 0.3 * first.problem.config.noise.robot_scale

    def at(linear: Linear) -> Iterator[ParameterBlock]:
        from_middle = linear.points_on_target - linear.points_on_target.mean(axis=0)
        stretched = (linear.by_point * from_middle).sum(axis=1)
        yield ParameterBlock('sensor_scale', stretched[:, None] * std, std)
    return at


def sensor_distortion(first: Linear) -> Blocks:
    """Return the blocks of the sensor's distortion: polynomials in its plane, one per degree."""
    std, degrees = first.problem.config.noise.distortion, list(DISTORTION)
    fields = bending(first.points_on_target, degrees) if std else []

    @cache
    def motions(linear: Linear) -> list[Array]:
        plane = of_mount(linear.estimate.X)
        return [plane @ each for each in field_motions(linear.points_on_target, degrees)]

    def at(linear: Linear) -> Iterator[ParameterBlock]:
        for i, (field, (degree, share)) in enumerate(zip(fields, DISTORTION.items(), strict=True)):
            size = std * share
            by_x, by_z = (linear.by_point * size).T[:, :, None]
            yield ParameterBlock(
                f'distortion_{degree}', by_x * field[:, 0] + by_z * field[:, 1], size,
                best_fit=partial(_motions_of_degree, motions, i),
                report='distortion_error')
    return at if std else _none


def _motions_of_degree(motions: Callable[[Linear], list[Array]], i: int, linear: Linear) -> Array:
    return motions(linear)[i]


def line_bend(first: Linear) -> Blocks:
    """Return the block of a light plane that is bent: its points are not at y = 0."""
    std = first.problem.config.noise.line_bend
    heights = bent_line(first.problem.observations.points)

    def best_fit(linear: Linear) -> Array:
        # the plane through the middle of the line instead: as a data sheet may have it
        motion = np.zeros((6, 2))
        motion[:3, 0] = -linear.estimate.X[:3, 1] / 3
        return motion

    def at(linear: Linear) -> Iterator[ParameterBlock]:
        across = linear.jacobian[:, :3] @ linear.estimate.X[:3, 1]
        yield ParameterBlock(LINE_BEND, across[:, None] * heights * std, std, best_fit=best_fit,
                             report=LINE_BEND)
    return at if std else _none


def pose_model(first: Linear) -> Blocks:
    """Return the blocks of the parameters in the problem's pose model, such as a time offset."""
    if first.problem.pose_model is None:
        return _none

    def retract_in(block: slice) -> Retraction:
        def retract(problem: Problem, estimate: Estimate, change: Array
                    ) -> tuple[Problem, Estimate]:
            values = problem.pose_values.copy()
            values[block] += change
            return problem.with_pose_values(values), estimate
        return retract

    def at(linear: Linear) -> Iterator[ParameterBlock]:
        model = linear.problem.pose_model
        assert model is not None
        _, twists = model.at(linear.problem.pose_values)
        last = np.cumsum(model.counts)
        for name, count, std, end in zip(model.names, model.counts, model.stds, last, strict=True):
            block = slice(int(end) - count, int(end))
            own = twists[:, :, block]
            yield ParameterBlock(name, linear.by_twists(own) * std, std, twists=own,
                                 retract=retract_in(block), least=model.least, report=name)
    return at


def best_fit_motions(linear: Linear, blocks: Sequence[ParameterBlock]) -> Array:
    """Return the derivatives (6, q) of the best-fit transform by the parameters of blocks."""
    parts = [np.zeros((6, block.count)) if block.best_fit is None else
             block.best_fit(linear) * block.std for block in blocks]
    return np.concatenate([np.zeros((6, 0)), *parts], axis=1)


def pose_corrections(problem: Problem, blocks: Sequence[ParameterBlock], values: Array) -> Array:
    """
    Return the corrections (n, 6) of the reported poses by the parameters of blocks.

    values: (q,) parameters of all blocks in order, in their present sigmas, or (n, q) for each
    pose.
    """
    n = len(problem.poses)
    errors, values = np.zeros((n, 6)), np.broadcast_to(values, (n, values.shape[-1]))
    first = 0
    for block in blocks:
        own = values[:, first:first + block.count]
        first += block.count
        if block.twists is None:
            continue
        if block.functions is not None:
            own = np.einsum('nak,nk->na', own.reshape(n, -1, block.functions.shape[1]),
                            block.functions)
        errors += block.std * np.einsum('nxk,nk->nx', block.twists, own)
    return errors


def _none(linear: Linear) -> Iterable[ParameterBlock]:
    return ()


SOURCES: tuple[Source, ...] = (
    stated_measures, robot_scale, sensor_scale, sensor_distortion, line_bend, pose_model,
    robot_smooth)
