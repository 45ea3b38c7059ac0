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


@dataclass(frozen=True, eq=False)
class State:
    """
    An estimate: the sensor in its mount X (4, 4), where the targets are, the arm.

    targets: (t, 3) of points, the parameters of the target of profiles. smooth: (r, 3) what is
    left of the robot's error, coefficients of smooth functions.
    """

    X: Array
    targets: Array
    arm: Arm
    smooth: Array

    def with_arm_moved(self, step: Array) -> State:
        """Return the state with the arm and what is left of its error moved by a step."""
        own, smooth = np.split(step, [len(self.arm.values)])
        return replace(self, arm=replace(self.arm, values=self.arm.values + own),
                       smooth=self.smooth + smooth.reshape(self.smooth.shape))


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

    def again(self, rows: NDArray[np.intp], q: Array) -> Points:
        """Return what rows (k,) would show with other postures q (k, joints) at these poses."""
        return replace(self, q=q, points=self.points[rows], target=self.target[rows],
                       number=self.number[rows], reported=None)

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

    def difference(self, state: State, other: State) -> Array:
        """Return by how much X and the targets (unknowns,) are off another state."""
        return np.append(se3.difference(state.X, other.X), state.targets - other.targets)

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
