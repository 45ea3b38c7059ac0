# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Reads the URDF of an arm; writes the corrected URDF and reads kinematics.yaml.

pinocchio reads the URDF; the resulting Chain does not depend on it.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
import re
from typing import Any
from xml.etree import ElementTree

from handeye_ros import se3
from handeye_ros.config import yaml_content
from handeye_ros.data import Array
from handeye_ros.errors import InputError, nearest
from handeye_ros.results.calibration_file import transform_from
from handeye_ros.robot.model import (
    Arm,
    Chain,
    COUNTS,
    Joint,
    motion,
    OFFSET,
    Parameter,
    PRIORS,
    PRISMATIC,
    REVOLUTE,
)
import numpy as np
from scipy.spatial.transform import Rotation
import yaml

FORMAT = 'handeye_ros/kinematics/1'
KINEMATICS_FILE = 'kinematics.yaml'
MOST_JOINTS = 8
FLANGES = ('tool0', 'flange', 'tool', 'tcp')  # usual names of the last frame
TYPES = ('revolute', 'continuous', 'prismatic', 'fixed')


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
    try:
        import pinocchio
    except ImportError as error:
        raise InputError('reading a URDF needs pinocchio: install the package '
                         'ros-jazzy-pinocchio, or handeye_ros[kinematics] with pip') from error
    root = _parsed(text, source)
    elements = {e.get('name', ''): e for e in root.findall('joint')}
    base, flange = _ends(elements, [e.get('name', '') for e in root.findall('link')],
                         base, flange, source)
    try:
        model = pinocchio.buildModelFromXML(text)
    except (ValueError, RuntimeError) as error:
        raise InputError(f'{source}: is no valid URDF: {error}') from error
    frames = [model.frames[model.getFrameId(name, pinocchio.BODY)] for name in (base, flange)]
    path = _path(model, frames[1].parentJoint, frames[0].parentJoint, source, base, flange)
    data = model.createData()
    neutral = pinocchio.neutral(model)
    pinocchio.computeJointJacobians(model, data, neutral)
    joints, to_parent = [], se3.inverse(frames[0].placement.homogeneous)
    for i in path:
        name = model.names[i]
        if elements[name].get('type') not in TYPES:
            raise InputError(
                f'{source}: the joint {name} is {elements[name].get("type")}; only revolute, '
                'continuous, prismatic and fixed joints can be corrected')
        index = model.joints[i].idx_v
        column = pinocchio.getJointJacobian(model, data, i, pinocchio.LOCAL)[:, index]
        origin = to_parent @ model.jointPlacements[i].homogeneous
        joints.append(_joint(name, origin, column, elements[name]))
        to_parent = np.eye(4)
    _require_serial(joints, source)
    return Chain(base, flange, tuple(joints), to_parent @ frames[1].placement.homogeneous)


def _parsed(text: str, source: object) -> ElementTree.Element:
    if '<xacro:' in re.sub('<!--.*?-->', '', text, flags=re.DOTALL):
        raise InputError(
            f'{source}: holds xacro macros: write it as URDF first, with "xacro FILE -o '
            'robot.urdf"')
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f'{source}: is no XML: {error}') from error
    if root.tag != 'robot':
        raise InputError(f'{source}: is no URDF: its first element is <{root.tag}>, not <robot>')
    return root


def _ends(elements: Mapping[str, Any], links: Sequence[str], base: str, flange: str,
          source: object) -> tuple[str, str]:
    """Return the names of the links that the chain begins and ends with; raises InputError."""
    children = [_link(element, 'child') for element in elements.values()]
    for child in children:
        if children.count(child) > 1:
            raise InputError(
                f'{source}: the link {child} hangs on two joints: a closed loop, such as a '
                'parallel linkage; only serial arms can be corrected')
    for name in filter(None, (base, flange)):
        if name not in links:
            raise InputError(
                f'{source}: has no link {name}{nearest(name, links)}; its links are '
                f'{", ".join(links)}')
    roots = [link for link in links if link not in children]
    if not base and len(roots) != 1:
        raise InputError(f'{source}: has {len(roots)} links without a parent; expected one')
    if flange:
        return base or roots[0], flange
    parents = {_link(element, 'parent') for element in elements.values()}
    last = [name for name in FLANGES if name in links][:1] or [
        link for link in links if link not in parents]
    if len(last) != 1:
        raise InputError(
            f'{source}: ends in several links ({", ".join(last)}): name the flange, as in '
            f'--flange {last[0]}')
    return base or roots[0], last[0]


def _link(element: Any, end: str) -> str:
    named = element.find(end)
    return '' if named is None else str(named.get('link', ''))


def _path(model: Any, last: int, first: int, source: object, base: str, flange: str) -> list[int]:
    """Return the indices of the joints after the first to the last one."""
    path: list[int] = []
    while last != first:
        if last == 0:
            raise InputError(
                f'{source}: the base {base} does not carry the flange {flange}: joints that move '
                'it do not belong to the arm; name another base')
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
        raise InputError(
            f'{source}: no joint moves between base and flange: name other links with --base and '
            '--flange')
    if len(joints) > MOST_JOINTS:
        raise InputError(
            f'{source}: {len(joints)} joints move between base and flange, but at most '
            f'{MOST_JOINTS} can be identified: name a base nearer to the flange with --base')


def corrected_urdf(urdf: str, arm: Arm) -> str:
    """
    Return a URDF with the same links and joints, the origins of the joints corrected.

    P_j D_j Exp(a_j o_j) replaces P_j; the errors that depend on joint values are left out.
    """
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    root = ElementTree.fromstring(urdf, parser)
    elements = {e.get('name'): e for e in root.findall('joint')}
    for i, joint in enumerate(arm.chain.joints):
        element = elements[joint.name]
        origin = element.find('origin')
        if origin is None:
            origin = ElementTree.SubElement(element, 'origin')
        xyz, rpy = (np.array([float(v) for v in origin.get(key, '0 0 0').split()])
                    for key in ('xyz', 'rpy'))
        stated = se3.transform(Rotation.from_euler('xyz', rpy).as_matrix(), xyz)
        T = stated @ arm.displacements[i] @ motion(joint, arm.of(i, OFFSET))[0]
        origin.set('xyz', ' '.join(f'{v:.12g}' for v in T[:3, 3]))
        origin.set('rpy', ' '.join(f'{v:.12g}' for v in se3.rpy(T)))
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding='unicode') + '\n'


def read_arm(path: Path) -> Arm:
    """Return the arm of a kinematics.yaml, or of the folder that holds it; raises InputError."""
    path = path / KINEMATICS_FILE if path.is_dir() else path
    try:
        content = yaml_content(path.read_text(encoding='utf-8'))
        if content.get('format') != FORMAT:
            raise InputError(
                f'{path}: its format is {content.get("format")!r}, expected {FORMAT}: it is '
                'written by "handeye kinematics"')
        joints, parameters, values = [], [], []
        for i, joint in enumerate(content['joints']):
            joints.append(_stored_joint(path, joint))
            for kind in (kind for kind in COUNTS if kind in joint):
                for index, value in enumerate(joint[kind]['value']):
                    parameters.append(Parameter(i, kind, index, PRIORS[kind][0]))
                    values.append(float(value))
        chain = Chain(str(content['base']), str(content['flange']), tuple(joints),
                      transform_from(path, 'end', content['end']))
        covariance, configurations = (
            np.array(content[key], dtype=float) if key in content else None
            for key in ('covariance', 'configurations'))
        for key, array, last in (('covariance', covariance, len(values)),
                                 ('configurations', configurations, len(joints))):
            if array is not None and not (array.ndim == 2 and array.shape[1] == last):
                raise ValueError(f'{key} has rows of other lengths than {last}')
    except OSError as error:
        raise InputError(f'{path}: cannot be read: {error.strerror}') from error
    except (UnicodeDecodeError, yaml.YAMLError, AttributeError, KeyError, TypeError,
            ValueError) as error:
        raise InputError(f'{path}: is no kinematics.yaml: {error}') from error
    return Arm(chain, tuple(parameters), np.array(values), covariance, configurations)


def _stored_joint(path: Path, values: Mapping[str, Any]) -> Joint:
    numbers = (float(values[key]) for key in ('factor', 'shift', 'lower', 'upper'))
    return Joint(str(values['name']), str(values['type']),
                 transform_from(path, 'origin', values['origin']),
                 np.array(values['axis'], dtype=float), str(values['follows']), *numbers)
