"""What is printed and written of a corrected arm: kinematics.yaml, corrected.urdf."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, UTC
import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from handeye_ros import __version__, se3
from handeye_ros.config import Config, flatten, yaml_content
from handeye_ros.data import Array, Calibration, Quality, SampleReport
from handeye_ros.frames import mount_frame, name_direction
from handeye_ros.kinematics.chain import Chain, Joint, motion, REVOLUTE
from handeye_ros.kinematics.errors import UrdfError
from handeye_ros.kinematics.model import Arm, COUNTS, OFFSET, ON_DEMAND, Parameter, PRIORS
from handeye_ros.kinematics.outcome import Outcome
from handeye_ros.kinematics.points import Points
from handeye_ros.output import write_whole
from handeye_ros.results import exports
from handeye_ros.results.calibration_file import transform_from, transform_values
from handeye_ros.se3 import worst_translation
import numpy as np
import yaml

FORMAT = 'handeye_ros/kinematics/1'
NAME, URDF = 'kinematics.yaml', 'corrected.urdf'
UNKNOWN = 0.9  # of the prior sigma: the data say next to nothing
HEADER = """\
# Errors of the joints and axes of an arm, found with the hand-eye transform in calibration.yaml.
# offset is added to the joint's reading; direction (rad) and position (m) turn and shift its axis
# across itself. known: sigma after over sigma before; {limit} or more: not determined.
"""


@dataclass(frozen=True, eq=False)
class Answer:
    """The corrected arm, and the hand-eye transform that belongs to it; warnings: sentences."""

    outcome: Outcome
    calibration: Calibration
    warnings: tuple[str, ...]

    @classmethod
    def of(cls, outcome: Outcome, calibration: Calibration, inputs: Sequence[dict[str, str]],
           warnings: Sequence[str]) -> Answer:
        """Return the answer; inputs: path and sha256 of all files; warnings: of the reading."""
        provenance = {**calibration.provenance, 'inputs': list(inputs)}
        return cls(outcome, replace(calibration, provenance=provenance),
                   (*warnings, *outcome.warnings))

    @property
    def arm(self) -> Arm:
        """Return the arm with its errors."""
        return self.outcome.arm


def calibration_of(outcome: Outcome, data: Points, config: Config) -> Calibration:
    """Return the hand-eye transform found from points, as calibration.yaml tells it."""
    fit, chain = outcome.chosen.fit, outcome.arm.chain
    config = replace(config, robot_base_frame=chain.base, robot_effector_frame=chain.flange)
    std, direction = worst_translation(outcome.covariance[:6, :6])
    parent, used = mount_frame(config), fit.used
    quality = Quality(int(used.sum()), int((~used).sum()), fit.noise_rms,
                      outcome.chosen.left_out_rms,
                      f'position along {name_direction(direction, parent)} (m)', std)
    samples = tuple(SampleReport(int(number), bool(good), data.names[target], float(distance),
                                 '' if good else 'contradicts the others')
                    for number, good, target, distance in zip(
                        data.number, used, data.target, data.distances(fit.state), strict=True))
    target = {f'point_{name}': dict(zip('xyz', map(float, centre), strict=True))
              for name, centre in zip(data.names, fit.state.targets, strict=True)}
    return Calibration(
        config.name or 'kinematics', 'kinematics', parent, config.sensor_frame, fit.state.X,
        outcome.covariance[:6, :6], {**target, 'robot_position_error': outcome.smooth}, quality,
        samples, {'version': __version__, 'config': flatten(config)})


def text(answer: Answer) -> str:
    """Return what is in kinematics.yaml."""
    outcome, arm, calibration = answer.outcome, answer.arm, answer.calibration
    provenance = {'version': __version__,
                  'created': datetime.now(UTC).isoformat(timespec='seconds'),
                  **calibration.provenance, 'warnings': list(answer.warnings)}
    content = {
        'format': FORMAT, 'name': calibration.name, 'base': arm.chain.base,
        'flange': arm.chain.flange, 'joints': _joints(outcome),
        'end': transform_values(arm.chain.end),
        'zero_offsets_degrees': {
            j.name: round(math.degrees(float(arm.of(i, OFFSET)[0])), 5)
            for i, j in enumerate(arm.chain.joints) if j.kind == REVOLUTE},
        'transform': transform_values(calibration.T_flange_sensor),
        'models': [{'parameters': list(m.kinds), 'residual_rms': m.residual,
                    'left_out_rms': m.left_out_rms, 'left_out_median': m.left_out_median,
                    'chosen': m is outcome.chosen} for m in outcome.models],
        'robot_smooth_error': outcome.smooth,
        'provenance': provenance}
    return HEADER.format(limit=UNKNOWN) + str(yaml.safe_dump(
        content, sort_keys=False, width=100, default_flow_style=None, allow_unicode=True))


def _joints(outcome: Outcome) -> list[dict[str, Any]]:
    arm, found = outcome.arm, []
    columns = {'value': arm.values, 'std': outcome.stds, 'known': outcome.known}
    for i, joint in enumerate(arm.chain.joints):
        values: dict[str, Any] = {
            'name': joint.name, 'type': joint.kind, 'origin': transform_values(joint.origin),
            'axis': joint.axis.tolist(), 'follows': joint.follows, 'factor': joint.factor,
            'shift': joint.shift, 'lower': joint.lower, 'upper': joint.upper}
        for kind in dict.fromkeys(p.kind for p in arm.parameters):
            own = [k for k, p in enumerate(arm.parameters) if (p.joint, p.kind) == (i, kind)]
            if own:
                values[kind] = {key: array[own].tolist() for key, array in columns.items()}
        found.append(values)
    return found


def read_arm(path: Path) -> Arm:
    """Return the arm of a kinematics.yaml, or of the folder that holds it; raises UrdfError."""
    path = path / NAME if path.is_dir() else path
    try:
        content = yaml_content(path.read_text(encoding='utf-8'))
        if content.get('format') != FORMAT:
            raise UrdfError(path, f'its format is {content.get("format")!r}, expected {FORMAT}: '
                            'it is written by "handeye kinematics"')
        joints, own, values = [], [], []
        for i, joint in enumerate(content['joints']):
            joints.append(_joint(path, joint))
            for kind in (kind for kind in COUNTS if kind in joint):
                for which, value in enumerate(joint[kind]['value']):
                    own.append(Parameter(i, kind, which, PRIORS[kind][0]))
                    values.append(float(value))
        chain = Chain(str(content['base']), str(content['flange']), tuple(joints),
                      transform_from(path, 'end', content['end']))
    except OSError as error:
        raise UrdfError(path, f'cannot be read: {error.strerror}') from error
    except (UnicodeDecodeError, yaml.YAMLError, AttributeError, KeyError, TypeError,
            ValueError) as error:
        raise UrdfError(path, f'is no kinematics.yaml: {error}') from error
    return Arm(chain, tuple(own), np.array(values))


def _joint(path: Path, values: Mapping[str, Any]) -> Joint:
    numbers = (float(values[key]) for key in ('factor', 'shift', 'lower', 'upper'))
    return Joint(str(values['name']), str(values['type']),
                 transform_from(path, 'origin', values['origin']),
                 np.array(values['axis'], dtype=float), str(values['follows']), *numbers)


def corrected_urdf(urdf: str, arm: Arm) -> str:
    """
    Return a URDF with the same links and joints, the origins of the joints corrected.

    P_j D_j Exp(a_j o_j) is a transform like P_j; what changes with the joints is left out.
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
        stated = se3.transform(_from_rpy(rpy), xyz)
        T = stated @ arm.displacements[i] @ motion(joint, arm.of(i, OFFSET))[0]
        origin.set('xyz', ' '.join(f'{v:.12g}' for v in T[:3, 3]))
        origin.set('rpy', ' '.join(f'{v:.12g}' for v in se3.rpy(T)))
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding='unicode') + '\n'


def _from_rpy(rpy: Array) -> Array:
    roll, pitch, yaw = (se3.exp_rotation(angle * axis)
                        for angle, axis in zip(rpy, np.eye(3), strict=True))
    return np.asarray(yaw @ pitch @ roll)


def save(answer: Answer, urdf: str, folder: Path, formats: Sequence[str]) -> str:
    """
    Write calibration.yaml, kinematics.yaml and corrected.urdf; return what was written.

    urdf: that of the robot as stated. The calibration names the kinematics that belong to it.
    """
    folder = folder.absolute()
    provenance = answer.calibration.provenance
    read_with = {**provenance['config'], 'kinematics': str(folder / NAME)}
    calibration = replace(answer.calibration, provenance={**provenance, 'config': read_with})
    saved = exports.save_all(calibration, folder, formats)
    write_whole(folder / NAME, text(answer))
    write_whole(folder / URDF, corrected_urdf(urdf, answer.arm))
    lost = [kind for kind in ON_DEMAND if kind in answer.outcome.chosen.kinds]
    without = f' (without {" and ".join(lost)}, which no URDF can hold)' if lost else ''
    return f'{saved}, {NAME}, {URDF}{without}'
