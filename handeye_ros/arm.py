# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A serial arm as stated by its URDF, with errors of joints and axes, by pinocchio.

T = prod_j P_j D_j Exp(a_j (q_j + o_j)) P_f (product of exponentials, each axis in the frame of the
previous joint): P_j is the stated placement of joint j, D_j a small shift and rotation orthogonal
to its axis a_j, o_j its zero offset. These are four parameters of an axis and one of its zero,
without redundancy even for parallel axes. kinematics.yaml holds such an arm.
"""
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
import re
from typing import Any
from xml.etree import ElementTree

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import InputError, nearest
from handeye_ros.estimation.noise import whitening
from handeye_ros.estimation.solve import Solution
from handeye_ros.results.calibration_file import (
    content_of,
    require_format,
    transform_from,
    unusable,
)
import numpy as np
from scipy.spatial.transform import Rotation

REVOLUTE, PRISMATIC = 'revolute', 'prismatic'
KINDS = {'revolute': REVOLUTE, 'continuous': REVOLUTE, 'prismatic': PRISMATIC}  # of URDF types
OFFSET, DIRECTION, POSITION = 'offset', 'direction', 'position'
GEOMETRY = (OFFSET, DIRECTION, POSITION)
# prior 1 sigma of a revolute joint and of a prismatic one (rad or m)
PRIORS = {OFFSET: (1e-3, 5e-4), DIRECTION: (5e-4, 5e-4), POSITION: (5e-4, 0.0)}
COUNTS = {OFFSET: 1, DIRECTION: 2, POSITION: 2}
LENGTH = 0.3  # m that count as much as a radian, between poses
ROUNDS, LARGEST_STEP = 20, 0.2  # of the search for joint values (rad or m)
FORMAT, KINEMATICS_FILE = 'handeye_ros/kinematics/', 'kinematics.yaml'
MOST_JOINTS = 8
FLANGES = ('tool0', 'flange', 'tool', 'tcp')  # usual names of the last frame


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

    def values(self, readings: Mapping[str, Any], source: object) -> Array:
        """Return the positions (..., joints) of all joints; raises InputError where one lacks."""
        for name in self.measured:
            if name not in readings:
                raise InputError(
                    f'{source}: there are no values of the joint {name}'
                    f'{nearest(name, list(readings))}; the joints with values are '
                    f'{", ".join(readings) or "none"}; name them as the URDF does')
        return np.stack([j.factor * readings[j.follows] + j.shift for j in self.joints], axis=-1)

    def measured_values(self, q: Array) -> dict[str, Array]:
        """Return the values (n,) by the names of measured, from the positions of all joints."""
        return {j.follows: (value - j.shift) / j.factor
                for j, value in zip(self.joints, q.T, strict=True)}

    def forward(self, q: Array) -> Array:
        """Return T_base_flange (n, 4, 4) at joint values (n, joints), without errors."""
        return Arm(self).forward(q)


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
    def offsets(self) -> Array:
        """Return the zero offsets (joints,)."""
        return np.array([self.of(j, OFFSET)[0] for j in range(len(self.chain.joints))])

    @cached_property
    def displacements(self) -> list[Array]:
        """Return each D_j (4, 4), the shift and turn of an axis."""
        return [se3.perturb(np.eye(4), np.concatenate([
            joint.across @ self.of(j, POSITION), joint.across @ self.of(j, DIRECTION)]))
            for j, joint in enumerate(self.chain.joints)]

    @cached_property
    def model(self) -> Any:
        """Return the pinocchio.Model with the errors of the axes; its last frame is the flange."""
        pinocchio = _pinocchio()
        model, parent = pinocchio.Model(), 0
        for joint, D in zip(self.chain.joints, self.displacements, strict=True):
            kind = (pinocchio.JointModelRevoluteUnaligned if joint.kind == REVOLUTE
                    else pinocchio.JointModelPrismaticUnaligned)
            parent = model.addJoint(parent, kind(joint.axis), pinocchio.SE3(joint.origin @ D),
                                    joint.name)
        model.addFrame(pinocchio.Frame(self.chain.flange, parent, 0,
                                       pinocchio.SE3(self.chain.end),
                                       pinocchio.FrameType.OP_FRAME))
        return model

    def forward(self, q: Array) -> Array:
        """Return T_base_flange (n, 4, 4) of reported joint values (n, joints)."""
        pinocchio, model = _pinocchio(), self.model
        data, T = model.createData(), np.empty((len(q), 4, 4))
        for k, row in enumerate(q + self.offsets):
            pinocchio.framesForwardKinematics(model, data, row)
            T[k] = data.oMf[model.nframes - 1].homogeneous
        return T

    def jacobians(self, q: Array) -> Array:
        """Return the twists (n, 6, joints) of the flange by the joints; see with_twists."""
        pinocchio, model = _pinocchio(), self.model
        data = model.createData()
        return np.array([
            pinocchio.computeFrameJacobian(model, data, row, model.nframes - 1,
                                           pinocchio.LOCAL_WORLD_ALIGNED)
            for row in q + self.offsets]).reshape(len(q), 6, -1)

    def with_twists(self, q: Array) -> tuple[Array, Array]:
        """
        Return T_base_flange (n, 4, 4), and the twists (n, 6, k) of the flange by the parameters.

        Per unit of each parameter: translation of the flange's origin and rotation, in the base.
        Each is a twist at the placement of its joint, carried to the flange by the adjoint.
        """
        if not self.parameters:
            return self.forward(q), np.zeros((len(q), 6, 0))
        pinocchio, model = _pinocchio(), self.model
        data = model.createData()
        T, ends = np.empty((len(q), 4, 4)), np.empty((len(q), len(self.chain.joints), 4, 4))
        for k, row in enumerate(q + self.offsets):
            pinocchio.framesForwardKinematics(model, data, row)
            T[k] = data.oMf[model.nframes - 1].homogeneous
            ends[k] = [data.oMi[j].homogeneous for j in range(len(self.chain.joints))]
        placements = ends @ np.array([joint.origin for joint in self.chain.joints])
        at = placements[:, [p.joint for p in self.parameters]]
        shift, turn = (np.einsum('nkij,kj->nki', at[:, :, :3, :3], each)
                       for each in self._twists_at_placements())
        shift = shift + se3.cross(turn, T[:, None, :3, 3] - at[:, :, :3, 3])
        return T, np.swapaxes(np.concatenate([shift, turn], axis=2), 1, 2)

    def _twists_at_placements(self) -> Array:
        """Return the shift and the turn (2, k, 3) per unit of each parameter, in its P_j."""
        twists = np.zeros((2, len(self.parameters), 3))
        for k, p in enumerate(self.parameters):
            joint = self.chain.joints[p.joint]
            if p.kind == OFFSET:
                twists[int(joint.kind == REVOLUTE), k] = (
                    self.displacements[p.joint][:3, :3] @ joint.axis)
            else:
                twists[int(p.kind == DIRECTION), k] = joint.across[:, p.index]
        return twists

    def joints_near(self, T_base_flange: Array) -> Array:
        """
        Return joint values (n, joints) at poses (n, 4, 4), from the nearest known configurations.

        Poses beyond reach get those that come near.
        """
        assert self.configurations is not None
        known = self.forward(self.configurations)
        apart = [np.linalg.norm(known[:, :3, 3] - T[:3, 3], axis=1)
                 + LENGTH * se3.angle(known[:, :3, :3] @ T[:3, :3].T) for T in T_base_flange]
        q = self.configurations[np.argmin(apart, axis=1)]
        for _ in range(ROUNDS):
            missing = np.array([se3.difference(T, at) for T, at in zip(
                T_base_flange, self.forward(q), strict=True)])
            step = np.einsum('njx,nx->nj', np.linalg.pinv(self.jacobians(q), rcond=1e-3), missing)
            q = q + step / np.maximum(np.abs(step).max(axis=1) / LARGEST_STEP, 1)[:, None]
        return np.asarray(q)


def with_arm_errors(solution: Solution, kinematics: Path) -> Solution:
    """
    Return a solution whose reported covariance includes that of the parameters of the arm.

    kinematics: the file of the arm that gave the poses. The covariance of X given the arm, plus
    G C G^T with G the change of X by the parameters, is that of X and the arm together, whether
    or not the arm was found from the same samples. Raises InputError for a file without C.
    """
    arm = read_arm(kinematics)
    if arm.covariance is None or arm.configurations is None:
        raise InputError(f'{kinematics} does not state how certain the arm is, so that the '
                         'certainty of the transform is unknown: write it again, with "handeye '
                         'kinematics"')
    _, twists = arm.with_twists(arm.joints_near(solution.problem.robot_poses))
    by_arm = whitening(solution.linear, solution.noise)(solution.linear.by_twists(twists))
    G = solution.covariance[:6] @ solution.columns.T @ by_arm
    before = np.zeros((6, 6)) if solution.contamination is None else solution.contamination
    return replace(solution, contamination=before + G @ arm.covariance @ G.T)


def read_arm(path: Path) -> Arm:
    """Return the arm of a kinematics.yaml, or of the folder that holds it; raises InputError."""
    path = path / KINEMATICS_FILE if path.is_dir() else path
    content = content_of(path)
    try:
        require_format(path, str(content.get('format')), FORMAT)
        joints, own, values = [], [], []
        for i, stored in enumerate(content['joints']):
            joints.append(Joint(
                str(stored['name']), str(stored['type']),
                transform_from(path, 'origin', stored['origin']),
                np.array(stored['axis'], dtype=float), str(stored['follows']),
                *(float(stored[key]) for key in ('factor', 'shift', 'lower', 'upper'))))
            for kind in (kind for kind in COUNTS if kind in stored):
                for index, value in enumerate(stored[kind]['value']):
                    own.append(Parameter(i, kind, index, PRIORS[kind][0]))
                    values.append(float(value))
        arrays = {key: np.array(content[key], dtype=float).reshape(-1, length)
                  for key, length in (('covariance', len(values)),
                                      ('configurations', len(joints))) if key in content}
        chain = Chain(str(content['base']), str(content['flange']), tuple(joints),
                      transform_from(path, 'end', content['end']))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise unusable(path, f'it is no kinematics.yaml ({error})') from error
    return Arm(chain, tuple(own), np.array(values), **arrays)


def read_chain(path: Path, base: str = '', flange: str = '') -> tuple[str, Chain]:
    """Return the text of a URDF, and its chain; see chain_of."""
    try:
        text = path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, 'strerror', None) or str(error)
        raise InputError(f'{path}: cannot be read: {reason}') from error
    return text, chain_of(text, base, flange, path)


def chain_of(text: str, base: str = '', flange: str = '', source: object = 'robot_description'
             ) -> Chain:
    """
    Return the chain of a URDF's text; raises InputError.

    base, flange: names of links; empty: the root, and the usual name or the only last link.
    """
    pinocchio = _pinocchio()
    if '<xacro:' in re.sub('<!--.*?-->', '', text, flags=re.DOTALL):
        raise InputError(f'{source}: holds xacro macros: write it as URDF first, with "xacro FILE '
                         '-o robot.urdf"')
    try:
        root = ElementTree.fromstring(text)
        elements = {e.attrib['name']: e for e in root.iterfind('joint')}
        base, flange = _ends(root, base, flange)
        model = pinocchio.buildModelFromXML(text)
    except (ElementTree.ParseError, KeyError, AttributeError, ValueError, RuntimeError) as error:
        raise InputError(f'{source}: is no valid URDF: {error}') from error
    first, last = (model.frames[model.getFrameId(name, pinocchio.BODY)] for name in (base, flange))
    above = last.parentJoint
    moving: list[int] = []
    while above not in (0, first.parentJoint):
        moving.insert(0, above)
        above = model.parents[above]
    if above != first.parentJoint:
        raise InputError(f'{source}: the base {base} does not carry the flange {flange}: joints '
                         'that move it do not belong to the arm; name another base')
    if not 0 < len(moving) <= MOST_JOINTS:
        raise InputError(f'{source}: {len(moving)} joints move between the base {base} and the '
                         f'flange {flange}; 1 to {MOST_JOINTS} can be identified: name other '
                         'links with --base and --flange')
    joints, to_parent = [], se3.inverse(first.placement.homogeneous)
    for i in moving:
        element = elements[model.names[i]]
        if element.get('type') not in KINDS:
            raise InputError(f'{source}: the joint {model.names[i]} is {element.get("type")}; '
                             'only revolute, continuous, prismatic and fixed joints can be '
                             'corrected')
        joints.append(_joint(element, to_parent @ model.jointPlacements[i].homogeneous))
        to_parent = np.eye(4)
    return Chain(base, flange, tuple(joints), to_parent @ last.placement.homogeneous)


def _pinocchio() -> Any:
    try:
        import pinocchio
    except ImportError as error:
        raise InputError('joint values of an arm need pinocchio: install the package '
                         'ros-jazzy-pinocchio, or handeye_ros[kinematics] with pip') from error
    return pinocchio


def _ends(root: ElementTree.Element, base: str, flange: str) -> tuple[str, str]:
    """Return the names of the links that the chain begins and ends with; raises ValueError."""
    links = [link.get('name', '') for link in root.iterfind('link')]
    parents, children = ([end.get('link', '') for end in root.iterfind(f'joint/{name}')]
                         for name in ('parent', 'child'))
    for name in filter(None, (base, flange)):
        if name not in links:
            raise ValueError(f'it has no link {name}{nearest(name, links)}; its links are '
                             f'{", ".join(links)}')
    for child in children:
        if children.count(child) > 1:
            raise ValueError(f'the link {child} hangs on two joints: a closed loop, such as a '
                             'parallel linkage; only serial arms can be corrected')
    last = [flange] if flange else [name for name in FLANGES if name in links][:1] or [
        link for link in links if link not in parents]
    if len(last) != 1:
        raise ValueError(f'it ends in several links ({", ".join(last)}): name the flange, as in '
                         f'--flange {", ".join(last[:1])}')
    return base or next((link for link in links if link not in children), ''), last[0]


def _joint(element: ElementTree.Element, origin: Array) -> Joint:
    """Return the joint of a URDF element, at its origin (4, 4) in the joint before."""
    def numbers(name: str, keys: Iterable[tuple[str, float]]) -> list[float]:
        found = element.find(name)
        return [default if found is None else float(found.get(key, default))
                for key, default in keys]
    found_axis, mimic = element.find('axis'), element.find('mimic')
    axis = np.array([1.0, 0, 0] if found_axis is None else
                    [float(v) for v in found_axis.get('xyz', '1 0 0').split()])
    lower, upper = numbers('limit', (('lower', 0.0), ('upper', 0.0)))
    if element.get('type') == 'continuous' or not lower < upper:
        lower, upper = -np.inf, np.inf  # not stated
    name = element.attrib['name']
    factor, shift = numbers('mimic', (('multiplier', 1.0), ('offset', 0.0)))
    return Joint(name, KINDS[element.attrib['type']], origin, axis / np.linalg.norm(axis),
                 name if mimic is None else mimic.get('joint', ''), factor, shift, lower, upper)


def corrected_urdf(urdf: str, arm: Arm) -> str:
    """
    Return a URDF with the same links and joints, the origins of the joints corrected.

    P_j D_j Exp(a_j o_j) replaces P_j.
    """
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    root = ElementTree.fromstring(urdf, parser)
    elements = {e.get('name'): e for e in root.findall('joint')}
    for joint, D, offset in zip(arm.chain.joints, arm.displacements, arm.offsets, strict=True):
        element = elements[joint.name]
        origin = element.find('origin')
        if origin is None:
            origin = ElementTree.SubElement(element, 'origin')
        xyz, rpy = (np.array([float(v) for v in origin.get(key, '0 0 0').split()])
                    for key in ('xyz', 'rpy'))
        stated = se3.transform(Rotation.from_euler('xyz', rpy).as_matrix(), xyz)
        along = offset * joint.axis
        zero = (se3.transform(se3.exp_rotation(along), np.zeros(3)) if joint.kind == REVOLUTE
                else se3.transform(np.eye(3), along))
        T = stated @ D @ zero
        origin.set('xyz', ' '.join(f'{v:.12g}' for v in T[:3, 3]))
        origin.set('rpy', ' '.join(f'{v:.12g}' for v in se3.rpy(T)))
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding='unicode') + '\n'
