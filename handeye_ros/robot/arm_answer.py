# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The corrected arm with its hand-eye transform, as files and on the screen."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path
from typing import Any

from handeye_ros import se3
from handeye_ros.arm import (
    corrected_urdf,
    FORMAT,
    KIND_OF_ERROR,
    KINDS,
    KINEMATICS_FILE,
    OFFSET,
    POSITION,
    REVOLUTE,
)
from handeye_ros.data import Calibration
from handeye_ros.output import write_atomically, yaml_text
from handeye_ros.results import exports
from handeye_ros.results.calibration_file import with_origin
from handeye_ros.results.printed import figures_table
from handeye_ros.robot.selection import ArmSelection, UNCHANGED_ARM
import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

URDF_FILE = 'corrected.urdf'
UNDETERMINED_SHARE = 0.9  # of the prior sigma: the data hardly determine the error
FILE_HEADER = """\
# Errors of the joints and axes of an arm, found with the hand-eye transform in calibration.yaml.
# offset is added to the joint's reading; direction (rad) and position (m) turn and shift its axis
# across itself. covariance: of all these values, in their order; configurations: joint values of
# which they were found. undetermined: sigma after over sigma before; above {limit}: not known.
"""


@dataclass(frozen=True, eq=False)
class ArmAnswer:
    """The corrected arm, and the hand-eye transform that belongs to it; warnings: sentences."""

    selection: ArmSelection
    calibration: Calibration
    warnings: tuple[str, ...]

    @property
    def joints(self) -> list[dict[str, Any]]:
        """Return the entries `joints` of kinematics.yaml: as stated, with the errors by kind."""
        arm, entries = self.selection.arm, []
        columns = {'value': arm.error_values, 'std': np.sqrt(np.diag(arm.covariance)),
                   'undetermined': self.selection.undetermined}
        joint_of, column_of = np.nonzero(arm.is_estimated)
        for j, joint in enumerate(arm.joints):
            rows_of = {kind: (joint_of == j) & (KIND_OF_ERROR[column_of] == kind)
                       for kind in arm.estimated_kinds}
            entries.append({
                'name': joint.name, 'type': joint.type,
                'origin': se3.transform_values(joint.origin),
                'axis': joint.axis.tolist(), 'lower': joint.lower, 'upper': joint.upper,
                **{kind: {name: column[rows].tolist() for name, column in columns.items()}
                   for kind, rows in rows_of.items() if rows.any()}})
        return entries

    def save(self, urdf: str, folder: Path, formats: Sequence[str]) -> str:
        """
        Write calibration.yaml, kinematics.yaml and corrected.urdf; return what was written.

        urdf: the stated one of the robot. The calibration names the kinematics file.
        """
        folder = folder.absolute()
        provenance = self.calibration.provenance
        read_with = {**provenance['config'], 'kinematics': str(folder / KINEMATICS_FILE)}
        calibration = replace(self.calibration, provenance={**provenance, 'config': read_with})
        saved = exports.save_all(calibration, folder, formats)
        write_atomically(folder / KINEMATICS_FILE,
                         FILE_HEADER.format(limit=UNDETERMINED_SHARE) + yaml_text(_content(self)))
        write_atomically(folder / URDF_FILE, corrected_urdf(urdf, self.selection.arm))
        return f'{saved}, {KINEMATICS_FILE}, {URDF_FILE}'


def _content(answer: ArmAnswer) -> dict[str, Any]:
    """Return the contents of kinematics.yaml."""
    selection, arm, calibration = answer.selection, answer.selection.arm, answer.calibration
    return {
        'format': FORMAT, 'name': calibration.name, 'base': arm.base,
        'flange': arm.flange, 'joints': answer.joints, 'end': se3.transform_values(arm.end),
        'zero_offsets_degrees': {
            joint.name: round(math.degrees(offset), 5)
            for joint, offset in zip(arm.joints, arm.errors[:, 0].tolist(), strict=True)
            if joint.type == REVOLUTE},
        'transform': se3.transform_values(calibration.T_flange_sensor),
        'models': [{'parameters': list(m.fit.arm.estimated_kinds),
                    'residual_rms': m.fit.residual_rms, 'left_out_rms': m.left_out_rms,
                    'chosen': m is selection.chosen} for m in selection.models],
        'robot_smooth_error': selection.robot_smooth,
        'covariance': arm.covariance.tolist(),
        'configurations': arm.configurations.round(6).tolist(),
        'provenance': {**with_origin(calibration).provenance, 'warnings': list(answer.warnings)}}


def table(answer: ArmAnswer) -> RenderableType:
    """
    Return the joints with their errors, and the cross-validation errors before and after.

    The last column names the kinds of errors of which the data determine no value.
    """
    joints = figures_table('joint', 'zero offset', 'axis direction', 'axis position', 'not known')
    for joint in answer.joints:
        cells, unknown = [], []
        for kind in KINDS:
            entry = joint.get(kind, {'value': [], 'std': [], 'undetermined': [0.0]})
            lengths = kind == POSITION or (kind == OFFSET and joint['type'] != REVOLUTE)
            factor, digits, unit = (1e3, 3, 'mm') if lengths else (math.degrees(1), 4, 'deg')
            values = [f'{value * factor:+.{digits}f} ± {std * factor:.{digits}f}'
                      for value, std in zip(entry['value'], entry['std'], strict=True)]
            cells.append(f'{", ".join(values)} {unit}' if values else '-')
            unknown += [kind] * (min(entry['undetermined']) > UNDETERMINED_SHARE)
        joints.add_row(joint['name'], *cells, ', '.join(unknown))
    stated, chosen = answer.selection.models[0], answer.selection.chosen
    return Group(
        Text('Zero offset: add it to the reading of the joint.'), joints,
        Text(f'model: {", ".join(answer.selection.arm.estimated_kinds) or UNCHANGED_ARM}; points '
             f'that were left out: {stated.left_out_rms * 1e3:.2f} mm RMS before, '
             f'{chosen.left_out_rms * 1e3:.2f} mm after; what is left of the error of the robot: '
             f'{answer.selection.robot_smooth * 1e3:.2f} mm (RMS, each axis)'))
