# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Points of fixed targets, measured by the sensor from many robot configurations.

r = T(q) X s - c for a sensor on the flange, and X s - T(q) c for one beside the robot, in the axes
of the sensor: s is the measured point, c the position of the target. The module also finds the
hand-eye transform from such points without an initial value.
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from handeye_ros import se3
from handeye_ros.arm import Arm, Chain, PRISMATIC
from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import graduated, Rows, System
from handeye_ros.robot.estimate import (
    adjusted,
    Fit,
    fitted,
    LEAST_NOISE,
    MINIMUM,
    State,
    Weights,
)
from handeye_ros.robot.outcome import (
    cause_of,
    Change,
    joint_notes,
    Outcome,
    solve,
    too_few,
)
from handeye_ros.tables import ANGLE, LENGTH, Table
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

SWEPT = 4000  # random rotations that are compared
APART = 0.2  # smallest angle between two starts (rad)
STARTS = 8  # number of refined starts
ROUGH = 1e-3  # 1 sigma (m) of the residuals of an inaccurate robot
SEED = 0  # of the search: the same points give the same answer
FEW = 2  # refined starts in the search for a cause


@dataclass(frozen=True, eq=False)
class Points:
    """
    The measurements.

    q: (n, joints) reported values of all joints; points: (n, 3) in the sensor frame; target: (n,)
    index of its target in names; number: (n,) of the row or stop. reported: (n, 4, 4) poses of the
    controller, None where there are none. on_flange: whether the sensor is on the flange.
    """

    q: Array
    points: Array
    target: NDArray[np.intp]
    names: tuple[str, ...]
    number: NDArray[np.intp]
    on_flange: bool = True
    reported: Array | None = None

    def __len__(self) -> int:
        """Return the number of configurations."""
        return len(self.q)

    def select(self, rows: NDArray[Any]) -> Points:
        """Return some rows, by their numbers or a mask; the names stay."""
        fields = {name: getattr(self, name)[rows] for name in ('q', 'points', 'target', 'number')}
        return replace(self, **fields, reported=None if self.reported is None
                       else self.reported[rows])

    @property
    def unknowns(self) -> int:
        """Return the number of unknowns without a prior: X and the targets."""
        return 6 + 3 * len(self.names)

    @property
    def block(self) -> NDArray[np.intp]:
        """Return the configuration (m,) of each residual."""
        return np.repeat(np.arange(len(self)), 3)

    @property
    def component(self) -> NDArray[np.intp]:
        """Return the noise component of each residual (m,): the axis of the sensor."""
        return np.tile(np.arange(3), len(self))

    def retracted(self, state: State, step: Array) -> State:
        """Return a state after a step: X, targets, parameters of the arm, smooth."""
        targets, arm_step = np.split(step[6:], [state.targets.size])
        return replace(state, X=se3.perturb(state.X, step[:6]),
                       targets=state.targets + targets.reshape(state.targets.shape)
                       ).with_arm_step(arm_step)

    def distances(self, state: State) -> Array:
        """Return the distances of points (n,) from predictions without the smooth part (m)."""
        residuals, _ = self._residuals_in_base(state, state.arm.forward(self.q))
        return np.asarray(np.linalg.norm(residuals, axis=1))

    def linearised(self, state: State, root: Array) -> tuple[Array, Array]:
        """
        Return residuals (3 n,) and their derivatives (3 n, u) by a step of the state.

        root: (n, r) the smooth functions at the configurations.
        """
        T, twists = state.arm.with_twists(self.q)
        n, t = len(self), len(state.targets)
        R = T[:, :3, :3]
        lever = self.points @ state.X[:3, :3].T
        residuals, axes = self._residuals_in_base(state, T)
        unit = np.broadcast_to(np.eye(3), (n, 3, 3))
        by_mount = np.concatenate([unit, -se3.skew(lever)], axis=2)
        by_targets = np.zeros((n, 3, 3 * t))
        if self.on_flange:
            sign, to_axes = 1.0, np.einsum('nij,nj->ni', R, lever + state.X[:3, 3])
            by_mount, by_target = R @ by_mount, -unit
        else:
            sign, to_axes = -1.0, np.einsum('nij,nj->ni', R, state.targets[self.target])
            by_target = -R
        for k in range(3):
            by_targets[np.arange(n), :, 3 * self.target + k] = by_target[:, :, k]
        by_arm = sign * (twists[:, :3] - se3.skew(to_axes) @ twists[:, 3:])
        by_smooth = np.einsum('nr,ij->nirj', sign * root, np.eye(3)).reshape(n, 3, -1)
        J = np.concatenate([by_mount, by_targets, by_arm, by_smooth], axis=2)
        residuals = residuals + sign * root @ state.smooth
        turned = np.swapaxes(axes, 1, 2)
        return (turned @ residuals[:, :, None]).ravel(), (turned @ J).reshape(3 * n, -1)

    def _residuals_in_base(self, state: State, T: Array) -> tuple[Array, Array]:
        """Return residuals (n, 3) and the axes of the sensor (n, 3, 3) in the base."""
        X, targets = state.X, state.targets[self.target]
        measured = self.points @ X[:3, :3].T + X[:3, 3]
        R, a = T[:, :3, :3], T[:, :3, 3]
        if self.on_flange:
            return np.einsum('nij,nj->ni', R, measured) + a - targets, R @ X[:3, :3]
        of_target = np.einsum('nij,nj->ni', R, targets) + a
        return measured - of_target, np.broadcast_to(X[:3, :3], R.shape)


def read_table(path: Path, chain: Chain, on_flange: bool) -> tuple[Points, tuple[str, ...]]:
    """
    Return the contents of a table, CSV or YAML, and a sentence for each peculiarity.

    A row for each configuration. Columns: the joints of the URDF with their unit
    (`joint_1 [degrees]`), `x [mm]`, `y [mm]`, `z [mm]` in the sensor frame; optional: `target`
    names the point where there are several, and `flange_x [mm]` ... `flange_qw` (or
    `flange_roll [deg]` ...) are the controller's own poses.
    Raises InputError and DataError.
    """
    table = Table(path)
    kinds = {j.follows: LENGTH if j.kind == PRISMATIC else ANGLE for j in chain.joints}
    readings = {name: table.values([name], kind)[:, 0] for name, kind in kinds.items()
                if table.has([name])}
    q = chain.values(readings, path)
    points = table.values(['x', 'y', 'z'], LENGTH)
    labels = table.text('target') if table.has(['target']) else ['target'] * len(points)
    names = tuple(dict.fromkeys(labels))
    pose = [f'flange_{axis}' for axis in 'xyz']
    reported = table.poses('flange') if table.has(pose) else None
    target = np.array([names.index(label) for label in labels], dtype=np.intp)
    unused = [name for name in table.names if table.kind(name) == ANGLE
              and name not in kinds and not name.startswith('flange_')]
    sentences = [f'the column {name} is no joint between {chain.base} and {chain.flange}: it is '
                 'not used' for name in unused]
    data = Points(q, points, target, names, np.arange(1, len(points) + 1), on_flange, reported)
    return data, (*sentences, *joint_notes(chain, readings))


def first_fit(data: Points, arm: Arm, max_starts: int = STARTS) -> Fit:
    """
    Return the hand-eye transform alone, with the arm as stated, whatever its residuals.

    max_starts: starts that are refined. Raises DataError.
    """
    if len(data) < MINIMUM:
        raise too_few(len(data))
    rough, no_smooth = Weights(np.full(3, ROUGH), np.zeros(0)), np.zeros((len(data), 0))

    def refit(state: State, weights: Array) -> State:
        return System(rows, data.retracted, data.block).reweighted(state, weights)

    def rows(at: State) -> Rows:
        r, J = data.linearised(at, no_smooth)
        return Rows(r / ROUGH, lambda: J / ROUGH)

    def squares(at: State) -> Array:
        return np.asarray((rows(at).residuals.reshape(-1, 3) ** 2).mean(axis=1))
    solutions = [graduated(start, squares, refit)
                 for start in starts(data, arm, max_starts, np.random.default_rng(SEED))]
    state = min(solutions, key=lambda solution: float(np.median(squares(solution))))
    final = squares(state)
    used = final <= 25.0 * max(float(np.median(final)), (LEAST_NOISE / ROUGH) ** 2)
    if used.sum() < MINIMUM:
        raise too_few(int(used.sum()))
    return adjusted(fitted(data, state, rough, used, no_smooth))


def starts(data: Points, arm: Arm, count: int, rng: np.random.Generator) -> list[State]:
    """
    Return up to `count` starts, best first, with the arm as stated.

    For a given rotation of the sensor the other unknowns are linear, so the squared residual is a
    quadratic function of the nine elements of the rotation. It is evaluated at random rotations.
    """
    T, n, t = arm.forward(data.q), len(data), len(data.names)
    R, a = T[:, :3, :3], T[:, :3, 3]
    unit = np.broadcast_to(np.eye(3), R.shape)
    to_mount, to_target = (R, unit) if data.on_flange else (unit, R)
    A = np.zeros((n, 3, 3 + 3 * t))
    A[:, :, :3] = to_mount
    for k in range(3):
        A[np.arange(n), :, 3 + 3 * data.target + k] = -to_target[:, :, k]
    b = a if data.on_flange else -a
    M = np.einsum('nij,nk->nijk', to_mount, data.points).reshape(3 * n, 9)
    columns = np.column_stack([M, b.ravel()])
    flat = A.reshape(3 * n, -1)
    inverse = np.linalg.pinv(flat, rcond=1e-9)
    residuals = columns - flat @ (inverse @ columns)
    gram = residuals.T @ residuals
    rotations = Rotation.random(SWEPT, random_state=rng).as_matrix()
    v = np.column_stack([rotations.reshape(-1, 9), np.ones(SWEPT)])
    cost = np.einsum('ki,ij,kj->k', v, gram, v)
    chosen: list[State] = []
    for i in np.argsort(cost, kind='stable'):
        turned = rotations[i]
        if all(se3.angle(turned @ s.X[:3, :3].T) > APART for s in chosen):
            linear = -inverse @ (columns @ v[i])
            chosen.append(State(se3.transform(turned, linear[:3]), linear[3:].reshape(t, 3), arm,
                                np.zeros((0, 3))))
        if len(chosen) == count:
            break
    return chosen


def cause_of_points(data: Points, chain: Chain) -> str:
    """Return the error that explains joint values and points, '' if none does."""
    def refit(change: Change) -> float:
        changed = replace(data, q=data.q @ change.joints.T, points=data.points * change.unit,
                          on_flange=data.on_flange != change.other_side)
        return first_fit(changed, Arm(chain), FEW).noise_rms
    return cause_of(chain, data.q, data.on_flange, refit)


def solve_points(data: Points, chain: Chain, limit: float) -> Outcome:
    """Return the corrected arm from points that a sensor measured; see outcome.solve."""
    return solve(first_fit(data, Arm(chain)), limit, lambda: cause_of_points(data, chain))
