"""
Points of fixed targets, as the sensor sees them from many robot configurations.

r = T(q) X s - c for a sensor on the flange, and X s - T(q) c for one beside the robot, in the axes
of the sensor: s is what is measured, c where the target is. And the hand-eye transform from them
with nothing given: where an estimate starts.
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.solver import graduated, Rows, System
from handeye_ros.kinematics.errors import (
    cause_of,
    Change,
    judged_joints,
    TooFewConfigurationsError,
)
from handeye_ros.kinematics.estimate import (
    adjusted,
    Fit,
    fitted,
    LEAST_NOISE,
    MINIMUM,
    State,
    Weights,
)
from handeye_ros.kinematics.model import Arm, Chain, PRISMATIC
from handeye_ros.tables import ANGLE, LENGTH, Table
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

SWEPT = 4000  # random rotations that are compared
APART = 0.2  # least angle between two starts (rad)
STARTS = 8  # how many are refined
ROUGH = 1e-3  # residuals (m) of a start, whose robot is only inaccurate
SEED = 0  # of the search: the same points give the same answer
FEW = 2  # starts: a cause is seen by any of them


@dataclass(frozen=True, eq=False)
class Points:
    """
    What was measured.

    q: (n, joints) reported values of all joints; points: (n, 3) in the sensor frame; target: (n,)
    which it is of, an index into names; number: (n,) of the row or stop. reported: (n, 4, 4) the
    controller's own poses, None where there are none. on_flange: where the sensor is.
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
        own = {name: getattr(self, name)[rows] for name in ('q', 'points', 'target', 'number')}
        return replace(self, **own, reported=None if self.reported is None
                       else self.reported[rows])

    def with_postures(self, rows: NDArray[np.intp], q: Array) -> Points:
        """Return what rows (k,) would show with other postures q (k, joints) at these poses."""
        return replace(self.select(rows), q=q, reported=None)

    @property
    def unknowns(self) -> int:
        """Return the number of unknowns without a prior: X and the targets."""
        return 6 + 3 * len(self.names)

    @property
    def block(self) -> NDArray[np.intp]:
        """Return the configuration (m,) that each residual is of."""
        return np.repeat(np.arange(len(self)), 3)

    @property
    def component(self) -> NDArray[np.intp]:
        """Return which noise (m,) each residual has: that of an axis of the sensor."""
        return np.tile(np.arange(3), len(self))

    def moved(self, state: State, step: Array) -> State:
        """Return a state moved by a step: X, targets, parameters of the arm, smooth."""
        targets, rest = np.split(step[6:], [state.targets.size])
        return replace(state, X=se3.perturb(state.X, step[:6]),
                       targets=state.targets + targets.reshape(state.targets.shape)
                       ).with_arm_moved(rest)

    def distances(self, state: State) -> Array:
        """Return by how far (n,) the configurations miss, without the smooth part (m)."""
        off, _ = self._off(state, state.arm.forward(self.q))
        return np.asarray(np.linalg.norm(off, axis=1))

    def linearised(self, state: State, root: Array) -> tuple[Array, Array]:
        """
        Return residuals (3 n,) and their derivatives (3 n, u) by a step of the state.

        root: (n, r) the smooth functions at the configurations.
        """
        T, twists = state.arm.with_twists(self.q)
        n, t = len(self), len(state.targets)
        R = T[:, :3, :3]
        lever = self.points @ state.X[:3, :3].T
        off, axes = self._off(state, T)
        unit = np.broadcast_to(np.eye(3), (n, 3, 3))
        by_mount = np.concatenate([unit, -se3.skew(lever)], axis=2)
        each = np.zeros((n, 3, 3 * t))
        if self.on_flange:
            sign, far = 1.0, np.einsum('nij,nj->ni', R, lever + state.X[:3, 3])
            by_mount, own = R @ by_mount, -unit
        else:
            sign, far = -1.0, np.einsum('nij,nj->ni', R, state.targets[self.target])
            own = -R
        for k in range(3):
            each[np.arange(n), :, 3 * self.target + k] = own[:, :, k]
        by_arm = sign * (twists[:, :3] - se3.skew(far) @ twists[:, 3:])
        by_smooth = np.einsum('nr,ij->nirj', sign * root, np.eye(3)).reshape(n, 3, -1)
        J = np.concatenate([by_mount, each, by_arm, by_smooth], axis=2)
        off = off + sign * root @ state.smooth
        turned = np.swapaxes(axes, 1, 2)
        return (turned @ off[:, :, None]).ravel(), (turned @ J).reshape(3 * n, -1)

    def _off(self, state: State, T: Array) -> tuple[Array, Array]:
        """Return residuals (n, 3) in the base, and the axes of the sensor there (n, 3, 3)."""
        X, targets = state.X, state.targets[self.target]
        seen = self.points @ X[:3, :3].T + X[:3, 3]
        R, a = T[:, :3, :3], T[:, :3, 3]
        if self.on_flange:
            return np.einsum('nij,nj->ni', R, seen) + a - targets, R @ X[:3, :3]
        of_target = np.einsum('nij,nj->ni', R, targets) + a
        return seen - of_target, np.broadcast_to(X[:3, :3], R.shape)


def read_table(path: Path, chain: Chain, on_flange: bool) -> tuple[Points, tuple[str, ...]]:
    """
    Return what a table holds, CSV or YAML, and a sentence for each thing that is odd.

    A row for each configuration. Columns: the joints of the URDF with their unit
    (`joint_1 [degrees]`), `x [mm]`, `y [mm]`, `z [mm]` in the sensor frame; optional: `target`
    names the point where there are several, and `flange_x [mm]` ... `flange_qw` (or
    `flange_roll [deg]` ...) are the controller's own poses.
    Raises TableError, JointNamesError, JointRangeError.
    """
    table = Table(path)
    kinds = {j.follows: LENGTH if j.kind == PRISMATIC else ANGLE for j in chain.joints}
    given = {name: table.values([name], kind)[:, 0] for name, kind in kinds.items()
             if table.has([name])}
    q = chain.values(given, path)
    points = table.values(['x', 'y', 'z'], LENGTH)
    labels = table.text('target') if table.has(['target']) else ['target'] * len(points)
    names = tuple(dict.fromkeys(labels))
    pose = [f'flange_{axis}' for axis in 'xyz']
    reported = table.poses('flange') if table.has(pose) else None
    target = np.array([names.index(label) for label in labels], dtype=np.intp)
    unused = [name for name in table.names if table.kind(name) == ANGLE
              and name not in kinds and not name.startswith('flange_')]
    odd = [f'the column {name} is no joint between {chain.base} and {chain.flange}: it is not '
           'used' for name in unused]
    data = Points(q, points, target, names, np.arange(1, len(points) + 1), on_flange, reported)
    return data, (*odd, *judged_joints(chain, given))


def first_fit(data: Points, arm: Arm, most: int = STARTS) -> Fit:
    """
    Return the hand-eye transform alone, with the arm as it is, however far it is off.

    most: starts that are refined. Raises TooFewConfigurationsError.
    """
    if len(data) < MINIMUM:
        raise TooFewConfigurationsError(len(data), MINIMUM)
    rough, nothing = Weights(np.full(3, ROUGH), np.zeros(0)), np.zeros((len(data), 0))

    def refit(state: State, weights: Array) -> State:
        return System(rows, data.moved, data.block).reweighted(state, weights)

    def rows(at: State) -> Rows:
        r, J = data.linearised(at, nothing)
        return Rows(r / ROUGH, lambda: J / ROUGH)

    def squares(at: State) -> Array:
        return np.asarray((rows(at).residuals.reshape(-1, 3) ** 2).mean(axis=1))
    ends = [graduated(start, squares, refit)
            for start in starts(data, arm, most, np.random.default_rng(SEED))]
    state = min(ends, key=lambda end: float(np.median(squares(end))))
    final = squares(state)
    used = final <= 25.0 * max(float(np.median(final)), (LEAST_NOISE / ROUGH) ** 2)
    if used.sum() < MINIMUM:
        raise TooFewConfigurationsError(int(used.sum()), MINIMUM)
    return adjusted(fitted(data, state, rough, used, nothing))


def starts(data: Points, arm: Arm, most: int, rng: np.random.Generator) -> list[State]:
    """
    Return up to `most` estimates to start from, the best first, without any error of the arm.

    For a given rotation of the sensor all else is linear, so the squared residual is a quadratic
    function of the nine numbers of a rotation. It is evaluated at many random rotations.
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
    both = np.column_stack([M, b.ravel()])
    flat = A.reshape(3 * n, -1)
    inverse = np.linalg.pinv(flat, rcond=1e-9)
    left = both - flat @ (inverse @ both)
    gram = left.T @ left
    rotations = Rotation.random(SWEPT, random_state=rng).as_matrix()
    v = np.column_stack([rotations.reshape(-1, 9), np.ones(SWEPT)])
    cost = np.einsum('ki,ij,kj->k', v, gram, v)
    chosen: list[State] = []
    for i in np.argsort(cost, kind='stable'):
        turned = rotations[i]
        if all(se3.angle(turned @ s.X[:3, :3].T) > APART for s in chosen):
            linear = -inverse @ (both @ v[i])
            chosen.append(State(se3.transform(turned, linear[:3]), linear[3:].reshape(t, 3), arm,
                                np.zeros((0, 3))))
        if len(chosen) == most:
            break
    return chosen


def cause_of_points(data: Points, chain: Chain) -> str:
    """Return what makes joint values and measured points agree, empty where nothing does."""
    def refit(change: Change) -> float:
        changed = replace(data, q=data.q @ change.joints.T, points=data.points * change.unit,
                          on_flange=data.on_flange != change.other_side)
        return first_fit(changed, Arm(chain), FEW).noise_rms
    return cause_of(chain, data.q, data.on_flange, refit)
