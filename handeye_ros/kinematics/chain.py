"""
A serial arm: its joints from the base to the flange, as a URDF states them.

pinocchio reads the URDF; what is kept of it is plain, and needs pinocchio no more.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
import re
from typing import Any
from xml.etree import ElementTree

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import nearest
from handeye_ros.kinematics.errors import JointNamesError, MissingPinocchioError, UrdfError
import numpy as np

REVOLUTE, PRISMATIC = 'revolute', 'prismatic'
MOST_JOINTS = 8
FLANGES = ('tool0', 'flange', 'tool', 'tcp')  # usual names of the last frame
TYPES = ('revolute', 'continuous', 'prismatic', 'fixed')


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
        T = np.tile(np.eye(4), (len(q), 1, 1))
        for joint, value in zip(self.joints, q.T, strict=True):
            T = T @ joint.origin @ motion(joint, value)
        return T @ self.end


def motion(joint: Joint, value: Array) -> Array:
    """Return the transforms (n, 4, 4) of a joint by its values (n,)."""
    along = value[:, None] * joint.axis
    if joint.kind == PRISMATIC:
        return se3.transform(np.broadcast_to(np.eye(3), (len(value), 3, 3)), along)
    return se3.transform(se3.exp_rotation(along), np.zeros_like(along))


def read_urdf(path: Path) -> str:
    """Return the text of a URDF; raises UrdfError."""
    try:
        return path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, 'strerror', None) or str(error)
        raise UrdfError(path, f'cannot be read: {reason}') from error


def chain_of(text: str, base: str = '', flange: str = '', source: object = 'robot_description'
             ) -> Chain:
    """
    Return the chain of a URDF's text; raises UrdfError and MissingPinocchioError.

    base, flange: names of links; empty: the root, and the usual name or the only last link.
    """
    try:
        import pinocchio
    except ImportError as error:
        raise MissingPinocchioError from error
    root = _parsed(text, source)
    elements = {e.get('name', ''): e for e in root.findall('joint')}
    base, flange = _ends(elements, [e.get('name', '') for e in root.findall('link')],
                         base, flange, source)
    try:
        model = pinocchio.buildModelFromXML(text)
    except (ValueError, RuntimeError) as error:
        raise UrdfError(source, f'is no valid URDF: {error}') from error
    frames = [model.frames[model.getFrameId(name, pinocchio.BODY)] for name in (base, flange)]
    path = _path(model, frames[1].parentJoint, frames[0].parentJoint, source, base, flange)
    data = model.createData()
    neutral = pinocchio.neutral(model)
    pinocchio.computeJointJacobians(model, data, neutral)
    joints, before = [], se3.inverse(frames[0].placement.homogeneous)
    for i in path:
        name = model.names[i]
        if elements[name].get('type') not in TYPES:
            raise UrdfError(source, f'the joint {name} is {elements[name].get("type")}; only '
                            'revolute, continuous, prismatic and fixed joints can be corrected')
        first = model.joints[i].idx_v
        column = pinocchio.getJointJacobian(model, data, i, pinocchio.LOCAL)[:, first]
        origin = before @ model.jointPlacements[i].homogeneous
        joints.append(_joint(name, origin, column, elements[name]))
        before = np.eye(4)
    _require_serial(joints, source)
    return Chain(base, flange, tuple(joints), before @ frames[1].placement.homogeneous)


def _parsed(text: str, source: object) -> ElementTree.Element:
    if '<xacro:' in re.sub('<!--.*?-->', '', text, flags=re.DOTALL):
        raise UrdfError(source, 'holds xacro macros: write it as URDF first, with "xacro FILE '
                        '-o robot.urdf"')
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise UrdfError(source, f'is no XML: {error}') from error
    if root.tag != 'robot':
        raise UrdfError(source, f'is no URDF: its first element is <{root.tag}>, not <robot>')
    return root


def _ends(elements: Mapping[str, Any], links: Sequence[str], base: str, flange: str,
          source: object) -> tuple[str, str]:
    """Return the names of the links that the chain begins and ends with; raises UrdfError."""
    children = [_link(element, 'child') for element in elements.values()]
    for child in children:
        if children.count(child) > 1:
            raise UrdfError(source, f'the link {child} hangs on two joints: a closed loop, such '
                            'as a parallel linkage; only serial arms can be corrected')
    for name in filter(None, (base, flange)):
        if name not in links:
            raise UrdfError(source, f'has no link {name}{nearest(name, links)}; its links are '
                            f'{", ".join(links)}')
    roots = [link for link in links if link not in children]
    if not base and len(roots) != 1:
        raise UrdfError(source, f'has {len(roots)} links without a parent; expected one')
    if flange:
        return base or roots[0], flange
    parents = {_link(element, 'parent') for element in elements.values()}
    last = [name for name in FLANGES if name in links][:1] or [
        link for link in links if link not in parents]
    if len(last) != 1:
        raise UrdfError(source, f'ends in several links ({", ".join(last)}): name the flange, as '
                        f'in --flange {last[0]}')
    return base or roots[0], last[0]


def _link(element: Any, end: str) -> str:
    found = element.find(end)
    return '' if found is None else str(found.get('link', ''))


def _path(model: Any, last: int, first: int, source: object, base: str, flange: str) -> list[int]:
    """Return the indices of the joints after the first to the last one."""
    path: list[int] = []
    while last != first:
        if last == 0:
            raise UrdfError(source, f'the base {base} does not carry the flange {flange}: joints '
                            'that move it do not belong to the arm; name another base')
        path.insert(0, last)
        last = model.parents[last]
    return path


def _joint(name: str, origin: Array, column: Array, element: ElementTree.Element) -> Joint:
    turning = float(np.linalg.norm(column[3:])) > 0.5
    limit, mimic = element.find('limit'), element.find('mimic')
    lower, upper = -np.inf, np.inf
    if limit is not None and element.get('type') != 'continuous':
        lower, upper = float(limit.get('lower', 0.0)), float(limit.get('upper', 0.0))
    if not lower < upper:
        lower, upper = -np.inf, np.inf  # not stated
    follows = (name, 1.0, 0.0) if mimic is None else (
        mimic.get('joint', ''), float(mimic.get('multiplier', 1.0)),
        float(mimic.get('offset', 0.0)))
    return Joint(name, REVOLUTE if turning else PRISMATIC, origin,
                 np.array(column[3:] if turning else column[:3]), *follows, lower, upper)


def _require_serial(joints: Sequence[Joint], source: object) -> None:
    if not joints:
        raise UrdfError(source, 'no joint moves between base and flange: name other links with '
                        '--base and --flange')
    if len(joints) > MOST_JOINTS:
        raise UrdfError(source, f'{len(joints)} joints move between base and flange, but at most '
                        f'{MOST_JOINTS} can be identified: name a base nearer to the flange '
                        'with --base')
