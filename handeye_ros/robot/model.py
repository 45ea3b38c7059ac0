# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A serial arm as stated by its URDF, and with errors of joints and axes: forward kinematics.

T = prod_j P_j D_j Exp(a_j (q_j + o_j)) P_f (product of exponentials, each axis in the frame of the
previous joint): P_j is the stated origin of joint j, D_j a small shift and rotation orthogonal to
its axis a_j, o_j its zero offset. These are four parameters of an axis and one of its zero,
without redundancy even for parallel axes.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import InputError, nearest
import numpy as np

REVOLUTE, PRISMATIC = 'revolute', 'prismatic'
OFFSET, DIRECTION, POSITION = 'offset', 'direction', 'position'
GEOMETRY = (OFFSET, DIRECTION, POSITION)
# prior 1 sigma of a revolute joint and of a prismatic one (rad or m)
PRIORS = {OFFSET: (1e-3, 5e-4), DIRECTION: (5e-4, 5e-4), POSITION: (5e-4, 0.0)}
COUNTS = {OFFSET: 1, DIRECTION: 2, POSITION: 2}
LENGTH = 0.3  # m that count as much as a radian, between poses
ROUNDS, LARGEST_STEP = 20, 0.2  # of the search for joint values (rad or m)
STEPS = 15  # configurations on the line from one to another


class JointNamesError(InputError):
    """Joint values with other names than the joints of the URDF."""

    @classmethod
    def missing(cls, source: object, joint: str, available: Sequence[str]) -> JointNamesError:
        """Return the error for a joint of the robot without values."""
        return cls(f'{source}: there are no values of the joint {joint}'
                   f'{nearest(joint, available)}; the joints with values are '
                   f'{", ".join(available) or "none"}; name them as the URDF does')


@dataclass(frozen=True, eq=False)
class Joint:
    """
    A movable joint.

    origin: (4, 4) its frame in that of the previous joint, at zero; axis: (3,) unit vector in its
    frame. Its value is factor * (value of the joint `follows`) + shift; a joint that mimics none
    follows itself. lower, upper: its limits (rad or m).
    """

    name: str
    kind: str
    origin: Array
    axis: Array
    follows: str
    factor: float = 1.0
    shift: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf

    @cached_property
    def across(self) -> Array:
        """Return two unit vectors (3, 2) orthogonal to the axis: for z, x and y."""
        helper = np.eye(3)[0 if abs(self.axis[0]) < 0.9 else 1]
        first = helper - self.axis * (self.axis @ helper)
        first /= np.linalg.norm(first)
        return np.column_stack([first, np.cross(self.axis, first)])


@dataclass(frozen=True, eq=False)
class Chain:
    """The joints between two frames; end: (4, 4) the flange in the frame of the last joint."""

    base: str
    flange: str
    joints: tuple[Joint, ...]
    end: Array

    @property
    def measured(self) -> tuple[str, ...]:
        """Return the names of the joints whose values are needed."""
        return tuple(dict.fromkeys(joint.follows for joint in self.joints))

    def values(self, readings: Mapping[str, Array], source: object) -> Array:
        """Return the positions of all joints, (n, joints); raises JointNamesError."""
        for name in self.measured:
            if name not in readings:
                raise JointNamesError.missing(source, name, list(readings))
        return np.stack([j.factor * readings[j.follows] + j.shift for j in self.joints], axis=-1)

    def measured_values(self, q: Array) -> dict[str, Array]:
        """Return the values (n,) by the names of measured, from the positions of all joints."""
        return {j.follows: (value - j.shift) / j.factor
                for j, value in zip(self.joints, q.T, strict=True)}

    def forward(self, q: Array) -> Array:
        """Return T_base_flange (n, 4, 4) at joint values (n, joints), without errors."""
        return self.frames(q)[-1]

    def frames(self, q: Array) -> list[Array]:
        """Return T_base (n, 4, 4) of each joint before its own motion, and of the flange."""
        T, frames = np.tile(np.eye(4), (len(q), 1, 1)), []
        for joint, value in zip(self.joints, q.T, strict=True):
            frames.append(T @ joint.origin)
            T = frames[-1] @ motion(joint, value)
        return [*frames, T @ self.end]


def motion(joint: Joint, value: Array) -> Array:
    """Return the transforms (n, 4, 4) of a joint at its values (n,)."""
    along = value[:, None] * joint.axis
    if joint.kind == PRISMATIC:
        return se3.transform(np.broadcast_to(np.eye(3), (len(value), 3, 3)), along)
    return se3.transform(se3.exp_rotation(along), np.zeros_like(along))


@dataclass(frozen=True)
class Parameter:
    """One error parameter: joint (index), kind, number within the kind, and prior sigma."""

    joint: int
    kind: str
    index: int
    prior: float


def parameters(chain: Chain, kinds: Sequence[str]) -> tuple[Parameter, ...]:
    """Return the parameters of some kinds for all joints, kind after kind."""
    return tuple(
        Parameter(j, kind, k, PRIORS[kind][joint.kind != REVOLUTE])
        for kind in kinds for j, joint in enumerate(chain.joints)
        if PRIORS[kind][joint.kind != REVOLUTE]
        for k in range(COUNTS[kind]))


@dataclass(frozen=True, eq=False)
class Arm:
    """
    A chain with the values (k,) of its error parameters.

    covariance: (k, k) of the values; configurations: (n, joints) of which they were found; None
    where they are not stated.
    """

    chain: Chain
    parameters: tuple[Parameter, ...] = ()
    values: Array = field(default_factory=lambda: np.zeros(0))
    covariance: Array | None = None
    configurations: Array | None = None

    @cached_property
    def stds(self) -> Array:
        """Return the prior sigmas (k,)."""
        return np.array([p.prior for p in self.parameters])

    def of(self, joint: int, kind: str) -> Array:
        """Return the values (COUNTS,) of a kind for a joint, 0 if they are not estimated."""
        values = np.zeros(COUNTS[kind])
        for parameter, value in zip(self.parameters, self.values, strict=True):
            if (parameter.joint, parameter.kind) == (joint, kind):
                values[parameter.index] = value
        return values

    @cached_property
    def displacements(self) -> list[Array]:
        """Return each D_j (4, 4), the shift and turn of an axis."""
        return [se3.perturb(np.eye(4), np.concatenate([
            joint.across @ self.of(j, POSITION), joint.across @ self.of(j, DIRECTION)]))
            for j, joint in enumerate(self.chain.joints)]

    def forward(self, q: Array) -> Array:
        """Return T_base_flange (n, 4, 4) of reported joint values (n, joints)."""
        return self.with_twists(q)[0]

    def with_twists(self, q: Array) -> tuple[Array, Array]:
        """
        Return T_base_flange (n, 4, 4), and the twists (n, 6, k) of the flange by the parameters.

        Per unit of each parameter: translation of the flange's origin and rotation, in the base.
        """
        T = np.tile(np.eye(4), (len(q), 1, 1))
        rotations, direct, origins = np.zeros((3, len(q), len(self.parameters), 3))
        for j, joint in enumerate(self.chain.joints):
            A = T @ joint.origin
            across = A[:, :3, :3] @ joint.across
            along = A[:, :3, :3] @ (self.displacements[j][:3, :3] @ joint.axis)
            value = q[:, j] + self.of(j, OFFSET)
            for k, p in enumerate(self.parameters):
                if p.joint != j:
                    continue
                origins[:, k] = A[:, :3, 3]
                if p.kind == POSITION:
                    direct[:, k] = across[:, :, p.index]
                elif p.kind == DIRECTION:
                    rotations[:, k] = across[:, :, p.index]
                else:
                    components = rotations if joint.kind == REVOLUTE else direct
                    components[:, k] = along
            T = A @ self.displacements[j] @ motion(joint, value)
        T = T @ self.chain.end
        translations = direct + se3.cross(rotations, T[:, None, :3, 3] - origins)
        return T, np.swapaxes(np.concatenate([translations, rotations], axis=2), 1, 2)


    def joints_near(self, T_base_flange: Array) -> Array:
        """
        Return joint values (n, joints) at poses (n, 4, 4), from the nearest known configurations.

        Poses beyond reach get those that come near.
        """
        assert self.configurations is not None
        offsets = replace(self, parameters=parameters(self.chain, (OFFSET,)), covariance=None)
        known = self.forward(self.configurations)
        apart = [np.linalg.norm(known[:, :3, 3] - T[:3, 3], axis=1)
                 + LENGTH * se3.angle(known[:, :3, :3] @ T[:3, :3].T) for T in T_base_flange]
        q = self.configurations[np.argmin(apart, axis=1)]
        for _ in range(ROUNDS):
            missing = np.array([se3.difference(T, at) for T, at in zip(
                T_base_flange, self.forward(q), strict=True)])
            _, J = replace(offsets, values=np.concatenate([
                self.of(j, OFFSET) for j in range(len(self.chain.joints))])).with_twists(q)
            step = np.einsum('njx,nx->nj', np.linalg.pinv(J, rcond=1e-3), missing)
            q = q + step / np.maximum(np.abs(step).max(axis=1) / LARGEST_STEP, 1)[:, None]
        return np.asarray(q)


def one_configuration(arm: Arm, q: Array) -> bool:
    """
    Return whether a six-axis arm stays on one side of all its singularities.

    Then no straight line in joint space from the first configuration to another crosses one.
    """
    chain, fractions = arm.chain, np.linspace(0.0, 1.0, STEPS)[:, None, None]
    if len(chain.joints) != 6 or any(joint.kind != REVOLUTE for joint in chain.joints):
        return False
    offsets = parameters(chain, (OFFSET,))
    between = (q[0] + fractions * (q - q[0])).reshape(-1, 6)
    _, J = Arm(chain, offsets, np.zeros(6)).with_twists(between)
    return len(np.unique(np.sign(np.linalg.det(J)))) == 1
