# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Writes and reads kinematics.yaml: an arm as its URDF states it, and its estimated errors.

Only the arm is read again; the other values are for the user.
"""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from itertools import chain
import math
from pathlib import Path
from typing import Any

from handeye_ros import se3
from handeye_ros.arm import Arm, Joint, KIND_OF_ERROR, KINDS, REVOLUTE
from handeye_ros.config import read_yaml
from handeye_ros.data import Array, Calibration
from handeye_ros.errors import unusable_file
from handeye_ros.output import yaml_text
from handeye_ros.results.calibration_file import with_origin
from handeye_ros.results.file_values import checked_numbers, require_format, transform_from
import numpy as np

FORMAT = 'handeye_ros/kinematics/1'
NAME = 'kinematics.yaml'
UNDETERMINED_SHARE = 0.9  # of the prior sigma: the data hardly determine the error
HEADER = f"""\
# Errors of the joints and axes of an arm, found with the hand-eye transform in calibration.yaml.
# offset is added to the joint's reading; direction (rad) and position (m) turn and shift its axis
# across itself. covariance: of all these values, in their order; configurations: joint values of
# which they were found. undetermined: sigma after over sigma before; above {UNDETERMINED_SHARE}: \
not known.
"""


@dataclass(frozen=True)
class TriedModel:
    """
    A model of the errors of an arm, as the file lists it.

    parameters: the kinds of errors that it has; chosen: whether it is that of the file
    residual_rms, left_out_rms: of the stops in its fit, and of those left out of it (m)
    """

    parameters: tuple[str, ...]
    residual_rms: float
    left_out_rms: float
    chosen: bool


def text(arm: Arm, undetermined: Array, models: Iterable[TriedModel], robot_smooth_error: float,
         calibration: Calibration) -> str:
    """
    Return the content of kinematics.yaml.

    undetermined: as in joint_entries; robot_smooth_error: what is left of the robot's error, RMS
    of each axis (m); calibration: the one that belongs to the arm, with its provenance.
    """
    return HEADER + yaml_text({
        'format': FORMAT, 'name': calibration.name, 'base': arm.base, 'flange': arm.flange,
        'joints': joint_entries(arm, undetermined), 'end': se3.transform_values(arm.end),
        'zero_offsets_degrees': {
            joint.name: round(math.degrees(offset), 5)
            for joint, offset in zip(arm.joints, arm.errors[:, 0].tolist(), strict=True)
            if joint.type == REVOLUTE},
        'transform': se3.transform_values(calibration.T_flange_sensor),
        'models': [asdict(model) for model in models], 'robot_smooth_error': robot_smooth_error,
        'covariance': arm.covariance, 'configurations': arm.configurations.round(6),
        'provenance': with_origin(calibration).provenance})


def joint_entries(arm: Arm, undetermined: Array) -> list[dict[str, Any]]:
    """
    Return an entry for each joint of an arm: the joint as stated, and its errors by kind.

    undetermined: (k,) posterior over prior sigma of each error value.
    """
    columns = {'value': arm.error_values, 'std': np.sqrt(np.diag(arm.covariance)),
               'undetermined': undetermined}
    joint_of, column_of = np.nonzero(arm.is_estimated)
    entries = []
    for j, joint in enumerate(arm.joints):
        rows_of = {kind: (joint_of == j) & (KIND_OF_ERROR[column_of] == kind)
                   for kind in arm.estimated_kinds}
        entries.append({
            'name': joint.name, 'type': joint.type, 'origin': se3.transform_values(joint.origin),
            'axis': joint.axis.tolist(), 'lower': joint.lower, 'upper': joint.upper,
            **{kind: {name: column[rows].tolist() for name, column in columns.items()}
               for kind, rows in rows_of.items() if rows.any()}})
    return entries


def read_arm(path: Path) -> Arm:
    """Return the arm of a kinematics.yaml, or of the folder that holds it; raises InputError."""
    path = path / NAME if path.is_dir() else path
    content = read_yaml(path)
    try:
        require_format(path, str(content.get('format')), FORMAT)
        stored = content['joints']
        joints = tuple(Joint(
            str(joint['name']), str(joint['type']),
            transform_from(path, 'origin', joint['origin']),
            checked_numbers(path, f'{joint["name"]}.axis', joint['axis'], 3),
            float(joint['lower']), float(joint['upper'])) for joint in stored)
        if any(math.isnan(limit) for joint in joints for limit in (joint.lower, joint.upper)):
            raise unusable_file(path, 'a limit of a joint is no number')
        kinds = tuple(kind for kind in KINDS if any(kind in joint for joint in stored))
        values = [value for joint in stored for kind in kinds if kind in joint
                  for value in checked_numbers(path, f'{joint["name"]}.{kind}',
                                               joint[kind]['value'])]
        arm = Arm(str(content['base']), str(content['flange']), joints,
                  transform_from(path, 'end', content['end']), kinds, np.array(values))
        if arm.is_estimated.sum() != len(values) or not content['configurations'] or any(
                joint.get('follows', joint['name']) != joint['name'] for joint in stored):
            raise unusable_file(path, 'errors of joints or all configurations are missing, or '
                                'joints follow others, as in files of earlier versions: run '
                                '"handeye kinematics" again')
        covariance, configurations = (checked_numbers(path, key, [*chain(*content[key])])
                                      for key in ('covariance', 'configurations'))
        return replace(arm, covariance=covariance.reshape(2 * [len(values)]),
                       configurations=configurations.reshape(-1, len(joints)))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise unusable_file(
            path, 'it is no kinematics.yaml as "handeye kinematics" writes it') from error
