"""
Points of fixed targets, as the sensor sees them from many robot configurations.

r = T(q) X s - c for a sensor on the flange, and X s - T(q) c for one beside the robot, in the axes
of the sensor: s is what is measured, c where the target is.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.kinematics.model import Arm
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

SWEPT = 4000  # rotations that a start is looked for among
APART = 0.2  # starts are turned by more than this against each other (rad)


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

    def select(self, keep: NDArray[np.bool_]) -> Points:
        """Return those where keep (n,) is true; the names stay."""
        return replace(self, q=self.q[keep], points=self.points[keep], target=self.target[keep],
                       number=self.number[keep],
                       reported=None if self.reported is None else self.reported[keep])


@dataclass(frozen=True, eq=False)
class State:
    """
    An estimate: the sensor in its mount X (4, 4), where the targets are (t, 3), the arm.

    smooth: (r, 3) what is left of the robot's error, coefficients of smooth functions.
    """

    X: Array
    targets: Array
    arm: Arm
    smooth: Array

    def moved(self, step: Array) -> State:
        """Return the state moved by a step: X, targets, parameters of the arm, smooth."""
        targets, rest = np.split(step[6:], [self.targets.size])
        own, smooth = np.split(rest, [len(self.arm.values)])
        return State(se3.perturb(self.X, step[:6]),
                     self.targets + targets.reshape(self.targets.shape),
                     replace(self.arm, values=self.arm.values + own),
                     self.smooth + smooth.reshape(self.smooth.shape))


def residuals(data: Points, state: State, T: Array) -> Array:
    """Return residuals (n, 3), in the axes of the sensor, with flange poses T (n, 4, 4)."""
    off, R = _off(data, state, T)
    return np.asarray(np.einsum('nji,nj->ni', R, off))


def _off(data: Points, state: State, T: Array) -> tuple[Array, Array]:
    """Return residuals (n, 3) in the base, and the axes of the sensor there (n, 3, 3)."""
    X, targets = state.X, state.targets[data.target]
    seen = data.points @ X[:3, :3].T + X[:3, 3]
    R, a = T[:, :3, :3], T[:, :3, 3]
    if data.on_flange:
        return np.einsum('nij,nj->ni', R, seen) + a - targets, R @ X[:3, :3]
    of_target = np.einsum('nij,nj->ni', R, targets) + a
    return seen - of_target, np.broadcast_to(X[:3, :3], R.shape)


def linearised(data: Points, state: State, root: Array) -> tuple[Array, Array]:
    """
    Return residuals (3 n,) and their derivatives (3 n, u) by a step of the state.

    root: (n, r) the smooth functions at the configurations.
    """
    T, twists = state.arm.with_twists(data.q)
    n, t = len(data), len(state.targets)
    R = T[:, :3, :3]
    lever = data.points @ state.X[:3, :3].T
    off, axes = _off(data, state, T)
    by_mount = np.concatenate([np.broadcast_to(np.eye(3), (n, 3, 3)), -se3.skew(lever)], axis=2)
    each = np.zeros((n, 3, 3 * t))
    if data.on_flange:
        sign, far = 1.0, np.einsum('nij,nj->ni', R, lever + state.X[:3, 3])
        by_mount, own = R @ by_mount, np.broadcast_to(-np.eye(3), (n, 3, 3))
    else:
        sign, far = -1.0, np.einsum('nij,nj->ni', R, state.targets[data.target])
        own = -R
    for k in range(3):
        each[np.arange(n), :, 3 * data.target + k] = own[:, :, k]
    by_arm = sign * (twists[:, :3] - se3.skew(far) @ twists[:, 3:])
    by_smooth = np.einsum('nr,ij->nirj', sign * root, np.eye(3)).reshape(n, 3, -1)
    J = np.concatenate([by_mount, each, by_arm, by_smooth], axis=2)
    off = off + sign * root @ state.smooth
    turned = np.swapaxes(axes, 1, 2)
    return (turned @ off[:, :, None]).ravel(), (turned @ J).reshape(3 * n, -1)


def starts(data: Points, arm: Arm, most: int, rng: np.random.Generator) -> list[State]:
    """
    Return so many estimates to start from, the best first, without any error of the arm.

    For a given rotation of the sensor all else is linear, so the squared residual is a quadratic
    function of the nine numbers of a rotation, which many are put into.
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
    found: list[State] = []
    for i in np.argsort(cost, kind='stable'):
        turned = rotations[i]
        if all(se3.angle(turned @ s.X[:3, :3].T) > APART for s in found):
            linear = -inverse @ (both @ v[i])
            found.append(State(se3.transform(turned, linear[:3]), linear[3:].reshape(t, 3), arm,
                               np.zeros((0, 3))))
        if len(found) == most:
            break
    return found
