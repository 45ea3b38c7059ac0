# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A serial arm as stated by its URDF, with errors of joints and axes, by pinocchio.

T = prod_j P_j D_j Exp(a_j (q_j + o_j)) P_f (product of exponentials, each axis in the frame of the
previous joint): P_j is the stated placement of joint j, D_j a small shift and rotation orthogonal
to its axis a_j, o_j its zero offset. These are four errors of an axis and one of its zero,
without redundancy even for parallel axes. robot/ estimates them, results/kinematics_file.py writes
and reads an arm with them.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
import re
from typing import Any
from xml.etree import ElementTree

from handeye_ros import se3
from handeye_ros.data import Array, TURN_LENGTH
from handeye_ros.errors import did_you_mean, InputError, unusable_file
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

REVOLUTE, PRISMATIC = 'revolute', 'prismatic'
URDF_TYPES = {'revolute': REVOLUTE, 'continuous': REVOLUTE, 'prismatic': PRISMATIC}
OFFSET, DIRECTION, POSITION = KINDS = ('offset', 'direction', 'position')
KIND_OF_ERROR = np.array([OFFSET, DIRECTION, DIRECTION, POSITION, POSITION])  # of a joint
# prior 1 sigma of them (rad or m), 0: it has no such error
PRIOR_STDS = {REVOLUTE: (1e-3, 5e-4, 5e-4, 5e-4, 5e-4), PRISMATIC: (5e-4, 5e-4, 5e-4, 0.0, 0.0)}
STEP_COUNT, MAX_STEP = 20, 0.2  # of the search for joint values (rad or m)
FLANGE_FRAMES = ('tool0', 'flange', 'tool', 'tcp')  # usual names of the last frame


@dataclass(frozen=True, eq=False)
class Joint:
    """
    A movable joint.

    origin: (4, 4) its frame in that of the previous joint, at zero
    type: REVOLUTE or PRISMATIC
    axis: (3,) unit vector in its frame
    lower, upper: its limits (rad or m)
    """

    name: str
    type: str
    origin: Array
    axis: Array
    lower: float = -np.inf
    upper: float = np.inf

    @cached_property
    def normal_basis(self) -> Array:
        """
        Return two unit vectors as columns (3, 2), orthogonal to the axis and to each other.

        They are in the frame of the joint; for the axis z they are x and y.
        """
        helper = np.eye(3)[0 if abs(self.axis[0]) < 0.9 else 1]
        first = se3.unit(helper - self.axis * (self.axis @ helper))
        return np.column_stack([first, np.cross(self.axis, first)])

    @property
    def twist(self) -> Array:
        """
        Return the screw (6,) of the joint in its own frame.

        That is its translation and rotation for a unit of its value.
        """
        zero = np.zeros(3)
        return np.append(zero, self.axis) if self.type == REVOLUTE else np.append(self.axis, zero)


@dataclass(frozen=True, eq=False)
class Arm:
    """
    The joints between two frames, with the errors that are estimated.

    base, flange: the names of these frames
    joints: from the base to the flange
    end: (4, 4) the flange in the frame of the last joint
    estimated_kinds: the kinds of errors that are estimated, of KINDS
    error_values: (k,) of the estimated errors, joint by joint, each in the order of KIND_OF_ERROR
    covariance: (k, k) of the error values
    configurations: (n, joints) values at which the errors were estimated; covariance and
        configurations are empty before
    """

    base: str
    flange: str
    joints: tuple[Joint, ...]
    end: Array
    estimated_kinds: tuple[str, ...] = ()
    error_values: Array = field(default_factory=lambda: np.zeros(0))
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    configurations: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def with_errors_of(self, kinds: Sequence[str]) -> Arm:
        """
        Return the arm with the errors of these kinds estimated, and the others removed.

        All estimated errors start at zero.
        """
        arm = replace(self, estimated_kinds=tuple(kinds), error_values=np.zeros(0))
        return replace(arm, error_values=np.zeros(arm.is_estimated.sum()))

    @cached_property
    def prior_stds(self) -> Array:
        """Return the prior 1 sigma (joints, 5) of all errors (rad or m), 0 where there is none."""
        return np.array([PRIOR_STDS[joint.type] for joint in self.joints])

    @cached_property
    def is_estimated(self) -> NDArray[np.bool_]:
        """
        Return a mask (joints, 5) of the estimated errors.

        error_values and prior_stds[mask] are in its order.
        """
        return (self.prior_stds > 0) & np.isin(KIND_OF_ERROR, self.estimated_kinds)

    @cached_property
    def errors(self) -> Array:
        """Return all errors (joints, 5) (rad or m), 0 where they are not estimated."""
        errors = np.zeros(self.is_estimated.shape)
        errors[self.is_estimated] = self.error_values
        return errors

    def joint_values(self, readings: Mapping[str, Any], source: object) -> Array:
        """
        Return the values (..., joints) of all joints, from those by name (rad or m).

        source: names them in the InputError that is raised where those of a joint are missing.
        """
        for joint in self.joints:
            if joint.name not in readings:
                raise InputError(
                    f'{source}: there are no values of the joint {joint.name}'
                    f'{did_you_mean(joint.name, list(readings))}; the joints with values are '
                    f'{", ".join(readings) or "none"}; name them as the URDF does')
        return np.stack([readings[joint.name] for joint in self.joints], axis=-1)

    @cached_property
    def displacements(self) -> Array:
        """Return D_j (joints, 4, 4), the shift and rotation of the axis of each joint."""
        return se3.perturb(np.eye(4), np.array([
            np.append(joint.normal_basis @ errors[3:], joint.normal_basis @ errors[1:3])
            for joint, errors in zip(self.joints, self.errors, strict=True)]))

    @cached_property
    def pinocchio_model(self) -> Any:
        """Return the pinocchio.Model with the errors of the axes; its last frame is the flange."""
        pinocchio = _pinocchio()
        model, parent = pinocchio.Model(), 0
        for joint, D in zip(self.joints, self.displacements, strict=True):
            kind = (pinocchio.JointModelRevoluteUnaligned if joint.type == REVOLUTE
                    else pinocchio.JointModelPrismaticUnaligned)
            parent = model.addJoint(parent, kind(joint.axis), pinocchio.SE3(joint.origin @ D),
                                    joint.name)
        model.addFrame(pinocchio.Frame(self.flange, parent, 0, pinocchio.SE3(self.end),
                                       pinocchio.FrameType.OP_FRAME))
        return model

    def forward(self, q: Array) -> Array:
        """Return T_base_flange (n, 4, 4) at reported joint values (n, joints) (rad or m)."""
        pinocchio, model = _pinocchio(), self.pinocchio_model
        data, T = model.createData(), np.empty((len(q), 4, 4))
        for k, positions in enumerate(q + self.errors[:, 0]):
            pinocchio.framesForwardKinematics(model, data, positions)
            T[k] = data.oMf[model.nframes - 1].homogeneous
        return T

    def error_jacobian(self, q: Array) -> Array:
        """
        Return the Jacobian (n, 6, joints, 5) of the flange by the geometric errors, in the base.

        The six are the translation of the flange's origin, and the rotation; q: (n, joints)
        reported joint values (rad or m).
        """
        pinocchio, model = _pinocchio(), self.pinocchio_model
        data, wrt_placements = model.createData(), np.empty((len(q), 6, 6 * len(self.joints)))
        for k, positions in enumerate(q + self.errors[:, 0]):
            pinocchio.forwardKinematics(model, data, positions)
            wrt_placements[k] = pinocchio.computeFrameKinematicRegressor(
                model, data, model.nframes - 1, pinocchio.LOCAL_WORLD_ALIGNED)
        wrt_errors = np.zeros((len(self.joints), 6, 5))  # of the placements, in their own axes
        for wrt_joint, joint, D in zip(wrt_errors, self.joints, self.displacements, strict=True):
            wrt_joint[:, 0] = joint.twist
            wrt_joint[3:, 1:3] = wrt_joint[:3, 3:] = D[:3, :3].T @ joint.normal_basis
        wrt_joints = wrt_placements.reshape(len(q), 6, -1, 6)
        return np.asarray(np.einsum('ntjs,jse->ntje', wrt_joints, wrt_errors))

    def inverse(self, T_base_flange: Array) -> Array:
        """
        Return the joint values (n, joints) at poses (n, 4, 4): the inverse of `forward`.

        Gauss-Newton steps of at most MAX_STEP (rad or m) start at the nearest of the known
        configurations; poses beyond reach get values that come near.
        """
        known, lengths = self.forward(self.configurations), np.repeat([1.0, TURN_LENGTH], 3)
        q = self.configurations[[
            np.argmin(np.linalg.norm(se3.difference(known, T) * lengths, axis=1))
            for T in T_base_flange]]
        for _ in range(STEP_COUNT):
            missing = se3.difference(T_base_flange, self.forward(q))
            J = self.error_jacobian(q)[..., 0]  # a joint moves the flange as its offset does
            step = np.einsum('njx,nx->nj', np.linalg.pinv(J, rcond=1e-3), missing)
            q = q + step / np.maximum(np.abs(step).max(axis=1) / MAX_STEP, 1)[:, None]
        return np.asarray(q)


def read_urdf(path: Path, base: str = '', flange: str = '') -> tuple[str, Arm]:
    """Return the text of a URDF, and the arm as `arm_of` reads it; raises InputError."""
    try:
        text = path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise unusable_file(path, getattr(error, 'strerror', None) or str(error)) from error
    return text, arm_of(text, base, flange, path)


def arm_of(text: str, base: str = '', flange: str = '', source: object = 'the URDF') -> Arm:
    """
    Return the arm of a URDF's text; raises InputError.

    base, flange: names of links; empty: the root, and the usual name or the only last link.
    """
    pinocchio = _pinocchio()
    if '<xacro:' in re.sub('<!--.*?-->', '', text, flags=re.DOTALL):
        raise InputError(f'{source}: holds xacro macros: write it as URDF first, with "xacro FILE '
                         '-o robot.urdf"')
    try:
        elements = {e.attrib['name']: e for e in ElementTree.fromstring(text).iterfind('joint')}
        model = pinocchio.buildModelFromXML(text)
        first, last = (model.frames[k] for k in _ends(model, base, flange))
    except (ElementTree.ParseError, KeyError, ValueError, RuntimeError) as error:
        raise InputError(f'{source}: is no valid URDF of a serial arm, without closed loops such '
                         f'as a parallel linkage: {error}') from error
    base, flange, moving = first.name, last.name, list(model.supports[last.parentJoint])
    if first.parentJoint not in moving[:-1]:
        raise InputError(f'{source}: no joint of the base {base} moves the flange {flange}: name '
                         'other links with --base and --flange')
    joints, to_parent = [], se3.inverse(first.placement.homogeneous)
    for i in moving[moving.index(first.parentJoint) + 1:]:
        element = elements[model.names[i]]
        kind = 'mimic' if element.find('mimic') is not None else element.get('type')
        if kind not in URDF_TYPES:
            raise InputError(f'{source}: the joint {model.names[i]} is {kind}; only revolute, '
                             'continuous, prismatic and fixed joints can be corrected, none that '
                             'mimics another')
        joints.append(_joint(element, to_parent @ model.jointPlacements[i].homogeneous))
        to_parent = np.eye(4)
    return Arm(base, flange, tuple(joints), to_parent @ last.placement.homogeneous)


def _pinocchio() -> Any:
    try:
        import pinocchio
    except ImportError as error:
        raise InputError('joint values of an arm need pinocchio: install the package '
                         'ros-jazzy-pinocchio, or handeye_ros[kinematics] with pip') from error
    return pinocchio


def _ends(model: Any, base: str, flange: str) -> tuple[int, int]:
    """Return the frames' numbers of the links at both ends; raises InputError."""
    frames = model.frames
    links = {f.name: k for k, f in enumerate(frames) if f.type == _pinocchio().FrameType.BODY}
    for name in filter(None, (base, flange)):
        if name not in links:
            raise InputError(f'the URDF has no link {name}{did_you_mean(name, list(links))}; its '
                             f'links are {", ".join(links)}: check --base and --flange')
    parents = {frames[frames[k].parentFrame].parentFrame for k in links.values()}
    last = [flange] if flange else [name for name in FLANGE_FRAMES if name in links][:1] or [
        name for name, k in links.items() if k not in parents]
    if len(last) != 1:
        raise InputError(f'the URDF ends in several links ({", ".join(last)}): name the flange, '
                         f'as in --flange {last[0]}')
    return links[base or next(iter(links))], links[last[0]]


def _joint(element: ElementTree.Element, origin: Array) -> Joint:
    """Return the joint of a URDF element, at its origin (4, 4) in the joint before."""
    name, kind = element.attrib['name'], element.attrib['type']
    axis, limit = (dict(child.attrib) if (child := element.find(tag)) is not None else {}
                   for tag in ('axis', 'limit'))
    along = np.array(axis.get('xyz', '1 0 0').split(), dtype=float)
    lower, upper = (float(limit.get(end, 0.0)) for end in ('lower', 'upper'))
    if kind == 'continuous' or not lower < upper:
        lower, upper = -np.inf, np.inf  # not stated
    return Joint(name, URDF_TYPES[kind], origin, se3.unit(along), lower, upper)


def corrected_urdf(urdf: str, arm: Arm) -> str:
    """
    Return a URDF with the same links and joints, the origins of the joints corrected.

    P_j D_j Exp(a_j o_j) replaces P_j.
    """
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    root = ElementTree.fromstring(urdf, parser)
    elements = {e.get('name'): e for e in root.findall('joint')}
    for joint, D, offset in zip(arm.joints, arm.displacements, arm.errors[:, 0], strict=True):
        element = elements[joint.name]
        origin = element.find('origin')
        if origin is None:
            origin = ElementTree.SubElement(element, 'origin')
        xyz, rpy = (np.array(origin.get(key, '0 0 0').split(), dtype=float)
                    for key in ('xyz', 'rpy'))
        stated = se3.transform(Rotation.from_euler('xyz', rpy).as_matrix(), xyz)
        T = stated @ D @ se3.perturb(np.eye(4), offset * joint.twist)
        origin.set('xyz', ' '.join(f'{v:.12g}' for v in T[:3, 3]))
        origin.set('rpy', ' '.join(f'{v:.12g}' for v in se3.rpy(T)))
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding='unicode') + '\n'
