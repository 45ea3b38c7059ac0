"""
A serial arm as stated, and with joints and axes that are not quite so: forward kinematics.

T = prod_j P_j D_j Exp(a_j (q_j + o_j)) P_f (product of exponentials, each axis in the frame of the
joint before): P_j the stated origin of joint j, D_j a small shift and turn across its axis a_j,
o_j its zero offset. Four numbers of an axis and one of its zero: no two are the same for any
directions of the axes, parallel ones too. On demand o_j also holds an error of the gear ratio,
an eccentricity, and the sag under the weight of the tool.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import InputError, nearest
import numpy as np

REVOLUTE, PRISMATIC = 'revolute', 'prismatic'
OFFSET, DIRECTION, POSITION = 'offset', 'direction', 'position'
GEAR, ECCENTRICITY, SAG = 'gear', 'eccentricity', 'sag'
GEOMETRY = (OFFSET, DIRECTION, POSITION)
ON_DEMAND = (GEAR, ECCENTRICITY, SAG)
# 1 sigma of each beforehand: of a revolute joint and of a prismatic one (rad or m; the gear ratio
# relative; sag: rad per metre of lever)
PRIORS = {OFFSET: (1e-3, 5e-4), DIRECTION: (5e-4, 5e-4), POSITION: (5e-4, 0.0),
          GEAR: (2e-4, 2e-4), ECCENTRICITY: (2e-4, 0.0), SAG: (3e-4, 0.0)}
COUNTS = {OFFSET: 1, DIRECTION: 2, POSITION: 2, GEAR: 1, ECCENTRICITY: 2, SAG: 1}
SAGGING = (1, 2)  # joints 2 and 3: they carry the arm
WAY = 15  # configurations on the way from one to another
DOWN = np.array([0.0, 0.0, -1.0])  # in the base, which stands upright


class JointNamesError(InputError):
    """Joint values and joints of the URDF that have different names."""

    @classmethod
    def missing(cls, source: object, joint: str, given: Sequence[str]) -> JointNamesError:
        """Return the error for a joint of the robot without values."""
        return cls(f'{source}: there are no values of the joint {joint}{nearest(joint, given)}; '
                   f'the joints with values are {", ".join(given) or "none"}; name them as the '
                   'URDF does')


@dataclass(frozen=True, eq=False)
class Joint:
    """
    A joint that moves.

    origin: (4, 4) its frame in that of the joint before, at zero; axis: (3,) unit vector in its
    frame. Its value is factor * that of the joint follows + shift; a joint that mimics none
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
        """Return two unit vectors (3, 2) across the axis: of z, they are x and y."""
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
        """Return the names of the joints that values are needed of."""
        return tuple(dict.fromkeys(joint.follows for joint in self.joints))

    def values(self, given: Mapping[str, Array], source: object) -> Array:
        """Return what all joints are at, (n, joints); raises JointNamesError."""
        for name in self.measured:
            if name not in given:
                raise JointNamesError.missing(source, name, list(given))
        return np.stack([j.factor * given[j.follows] + j.shift for j in self.joints], axis=-1)

    def given(self, q: Array) -> dict[str, Array]:
        """Return the values (n,) by the names of measured, of what all joints are at."""
        return {j.follows: (value - j.shift) / j.factor
                for j, value in zip(self.joints, q.T, strict=True)}

    def forward(self, q: Array) -> Array:
        """Return T_base_flange (n, 4, 4) of joint values (n, joints), without any error."""
        return self.frames(q)[-1]

    def frames(self, q: Array) -> list[Array]:
        """Return T_base (n, 4, 4) of each joint before its own motion, then of the flange."""
        T, frames = np.tile(np.eye(4), (len(q), 1, 1)), []
        for joint, value in zip(self.joints, q.T, strict=True):
            frames.append(T @ joint.origin)
            T = frames[-1] @ motion(joint, value)
        return [*frames, T @ self.end]


def motion(joint: Joint, value: Array) -> Array:
    """Return the transforms (n, 4, 4) of a joint by its values (n,)."""
    along = value[:, None] * joint.axis
    if joint.kind == PRISMATIC:
        return se3.transform(np.broadcast_to(np.eye(3), (len(value), 3, 3)), along)
    return se3.transform(se3.exp_rotation(along), np.zeros_like(along))


@dataclass(frozen=True)
class Parameter:
    """One number: of which joint (index), what it is, which of it, and its prior sigma."""

    joint: int
    kind: str
    which: int
    prior: float


def parameters(chain: Chain, kinds: Sequence[str]) -> tuple[Parameter, ...]:
    """Return the parameters of some kinds of all joints, kind after kind."""
    return tuple(
        Parameter(j, kind, k, PRIORS[kind][joint.kind != REVOLUTE])
        for kind in kinds for j, joint in enumerate(chain.joints)
        if PRIORS[kind][joint.kind != REVOLUTE] and (kind != SAG or j in SAGGING)
        for k in range(COUNTS[kind]))


@dataclass(frozen=True, eq=False)
class Arm:
    """A chain with the values (k,) of its error parameters."""

    chain: Chain
    parameters: tuple[Parameter, ...] = ()
    values: Array = field(default_factory=lambda: np.zeros(0))

    @cached_property
    def stds(self) -> Array:
        """Return the prior sigmas (k,)."""
        return np.array([p.prior for p in self.parameters])

    def of(self, joint: int, kind: str) -> Array:
        """Return the values (COUNTS,) of a kind of a joint, 0 where they are not estimated."""
        values = np.zeros(COUNTS[kind])
        for parameter, value in zip(self.parameters, self.values, strict=True):
            if (parameter.joint, parameter.kind) == (joint, kind):
                values[parameter.which] = value
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
        Return T_base_flange (n, 4, 4), and by how much the flange moves (n, 6, k).

        Per unit of each parameter: translation of the flange's origin and rotation, in the base.
        """
        T = np.tile(np.eye(4), (len(q), 1, 1))
        levers = _levers(self.chain, q) if any(p.kind == SAG for p in self.parameters) else {}
        turns, shifts, origins = np.zeros((3, len(q), len(self.parameters), 3))
        for j, joint in enumerate(self.chain.joints):
            A = T @ joint.origin
            across = A[:, :3, :3] @ joint.across
            along = A[:, :3, :3] @ (self.displacements[j][:3, :3] @ joint.axis)
            value = q[:, j] + self._offset(j, q[:, j], levers)
            for k, p in enumerate(self.parameters):
                if p.joint != j:
                    continue
                origins[:, k] = A[:, :3, 3]
                if p.kind == POSITION:
                    shifts[:, k] = across[:, :, p.which]
                elif p.kind == DIRECTION:
                    turns[:, k] = across[:, :, p.which]
                else:
                    part = turns if joint.kind == REVOLUTE else shifts
                    part[:, k] = along * _share(p, joint, q[:, j], levers)[:, None]
            T = A @ self.displacements[j] @ motion(joint, value)
        T = T @ self.chain.end
        moved = shifts + se3.cross(turns, T[:, None, :3, 3] - origins)
        return T, np.swapaxes(np.concatenate([moved, turns], axis=2), 1, 2)

    def _offset(self, joint: int, q: Array, levers: dict[int, Array]) -> Array:
        """Return what is added (n,) to the values (n,) of a joint."""
        total = np.zeros(len(q))
        for parameter, value in zip(self.parameters, self.values, strict=True):
            if parameter.joint == joint and parameter.kind not in (DIRECTION, POSITION):
                total += value * _share(parameter, self.chain.joints[joint], q, levers)
        return total


def _share(parameter: Parameter, joint: Joint, q: Array, levers: dict[int, Array]) -> Array:
    """Return what is added (n,) to the values (n,) of a joint per unit of a parameter."""
    if parameter.kind == GEAR:
        return q
    if parameter.kind == ECCENTRICITY:
        return np.sin(q) if parameter.which == 0 else np.cos(q) - 1.0
    return levers[parameter.joint] if parameter.kind == SAG else np.ones(len(q))


def _levers(chain: Chain, q: Array) -> dict[int, Array]:
    """Return the horizontal distances (n,) of the flange from the axes that sag, signed."""
    *frames, flange = chain.frames(q)
    return {j: (se3.cross(flange[:, :3, 3] - frames[j][:, :3, 3], DOWN) * (
        frames[j][:, :3, :3] @ chain.joints[j].axis)).sum(axis=1)
        for j in SAGGING if j < len(frames)}


def one_configuration(arm: Arm, q: Array) -> bool:
    """
    Tell whether a six-axis arm stays on one side of all its singular configurations.

    That is: no straight way in joint space from the first to another one passes through one.
    """
    chain, ways = arm.chain, np.linspace(0.0, 1.0, WAY)[:, None, None]
    if len(chain.joints) != 6 or any(joint.kind != REVOLUTE for joint in chain.joints):
        return False
    own = parameters(chain, (OFFSET,))
    between = (q[0] + ways * (q - q[0])).reshape(-1, 6)
    _, J = Arm(chain, own, np.zeros(6)).with_twists(between)
    return len(np.unique(np.sign(np.linalg.det(J)))) == 1
