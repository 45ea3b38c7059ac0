# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The corrected arm with its hand-eye transform, as files and on the screen."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path

from handeye_ros.arm import corrected_urdf, KINDS, OFFSET, POSITION, REVOLUTE
from handeye_ros.data import Calibration
from handeye_ros.results import exports, kinematics_file
from handeye_ros.results.kinematics_file import joint_entries, TriedModel, UNDETERMINED_SHARE
from handeye_ros.results.printed import figures_table
from handeye_ros.robot.selection import ArmSelection, UNCHANGED_ARM
from rich.console import Group, RenderableType
from rich.text import Text

URDF_FILE = 'corrected.urdf'


@dataclass(frozen=True, eq=False)
class ArmAnswer:
    """The corrected arm, and the hand-eye transform that belongs to it; warnings: sentences."""

    selection: ArmSelection
    calibration: Calibration
    warnings: tuple[str, ...]

    def save(self, urdf: str, folder: Path, formats: Sequence[str]) -> str:
        """
        Write kinematics.yaml, corrected.urdf and the calibration; return as exports.save_all.

        urdf: the stated one of the robot. The calibration names the kinematics file.
        """
        selection, provenance = self.selection, self.calibration.provenance
        file = folder.expanduser().absolute() / kinematics_file.NAME
        read_with = {**provenance['config'], 'kinematics': str(file)}
        calibration = replace(self.calibration, provenance={**provenance, 'config': read_with})
        models = [TriedModel(model.fit.arm.estimated_kinds, model.fit.residual_rms,
                             model.left_out_rms, model is selection.chosen)
                  for model in selection.models]
        return exports.save_all(calibration, folder, formats, {
            file.name: kinematics_file.text(
                selection.arm, selection.undetermined, models, selection.robot_smooth, replace(
                    self.calibration, provenance={**provenance, 'warnings': list(self.warnings)})),
            URDF_FILE: corrected_urdf(urdf, selection.arm)})


def table(answer: ArmAnswer) -> RenderableType:
    """
    Return the joints with their errors, and the cross-validation errors before and after.

    The last column names the kinds of errors of which the data determine no value.
    """
    joints = figures_table('joint', 'zero offset', 'axis direction', 'axis position', 'not known')
    for joint in joint_entries(answer.selection.arm, answer.selection.undetermined):
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
