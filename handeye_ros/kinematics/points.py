"""
Points of fixed targets, as the sensor sees them from many robot configurations.

r = T(q) X s - c for a sensor on the flange, and X s - T(q) c for one beside the robot, in the axes
of the sensor: s is what is measured, c where the target is.

They come from a CSV or YAML table, a row for each configuration. Columns named as the joints of
the URDF with their unit (`joint_1 [degrees]`), `x [mm]`, `y [mm]`, `z [mm]` in the sensor frame;
optional: `target` names the point where there are several, and `flange_x [mm]` ... `flange_qw` (or
`flange_roll [deg]` ...) are the controller's own poses.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
import math
from pathlib import Path
from typing import Any

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.files.tables import ANGLE, LENGTH, Table
from handeye_ros.kinematics.chain import Chain, PRISMATIC
from handeye_ros.kinematics.errors import JointRangeError
from handeye_ros.kinematics.model import Arm
import numpy as np
from numpy.typing import NDArray

BEYOND = {ANGLE: 0.35, LENGTH: 0.1}  # what limits may be passed by: they are often stated roughly
STILL = {ANGLE: 0.02, LENGTH: 0.005}  # a joint that moves by less tells nothing of itself
ALONE = 'target'  # the name of the point of a table without that column


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

    def select(self, rows: NDArray[Any]) -> Points:
        """Return some rows, by their numbers or a mask; the names stay."""
        own = {name: getattr(self, name)[rows] for name in ('q', 'points', 'target', 'number')}
        return replace(self, **own, reported=None if self.reported is None
                       else self.reported[rows])

    def again(self, rows: NDArray[np.intp], q: Array) -> Points:
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
    Return what a table holds, and a sentence for each thing that is odd.

    Raises TableError, JointNamesError, JointRangeError.
    """
    table = Table(path)
    kinds = {j.follows: LENGTH if j.kind == PRISMATIC else ANGLE for j in chain.joints}
    given = {name: table.values([name], kind)[:, 0] for name, kind in kinds.items()
             if table.has([name])}
    q = chain.values(given, path)
    points = table.values(['x', 'y', 'z'], LENGTH)
    labels = table.text('target') if table.has(['target']) else [ALONE] * len(points)
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


def judged_joints(chain: Chain, given: Mapping[str, Array]) -> list[str]:
    """
    Return a sentence for each joint that tells nothing of itself.

    Raises JointRangeError for one that goes where it cannot be.
    """
    odd = []
    for joint in chain.joints:
        kind = LENGTH if joint.kind == PRISMATIC else ANGLE
        value = joint.factor * given[joint.follows] + joint.shift
        low, high = float(value.min()), float(value.max())
        for end in (low, high):
            if not joint.lower - BEYOND[kind] <= end <= joint.upper + BEYOND[kind]:
                raise JointRangeError(joint.name, end, joint.lower, joint.upper)
        if high - low < STILL[kind]:
            size = (f'{math.degrees(high - low):.2g} degrees' if kind == ANGLE
                    else f'{(high - low) * 1e3:.2g} mm')
            odd.append(f'{joint.name} moves by {size} only: these configurations do not determine '
                       'its error')
    return odd
