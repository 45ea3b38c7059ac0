# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The corrected arm with its hand-eye transform: from a table of points, and as files."""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, UTC
import math
from pathlib import Path
from typing import Any

from handeye_ros import __version__, se3
from handeye_ros.arm import (
    Arm,
    Chain,
    corrected_urdf,
    COUNTS,
    DIRECTION,
    FORMAT,
    KINEMATICS_FILE,
    OFFSET,
    POSITION,
    REVOLUTE,
)
from handeye_ros.config import Config, flatten
from handeye_ros.data import Array, Calibration, Quality, SampleReport
from handeye_ros.frames import mount_frame, name_direction
from handeye_ros.output import write_whole
from handeye_ros.results import exports
from handeye_ros.results.calibration_file import transform_values
from handeye_ros.robot.outcome import Outcome
from handeye_ros.robot.points import Points, read_table, solve_points
from handeye_ros.se3 import worst_translation
import numpy as np
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text
import yaml

NAME, URDF = KINEMATICS_FILE, 'corrected.urdf'
UNKNOWN = 0.9  # of the prior sigma: the data hardly determine the parameter
OTHER_FRAMES = 0.02  # m, rad: larger differences mean other frames than those of the URDF
MOST_CONFIGURATIONS = 200  # that are stored, to find the joint values of poses
EQUAL = 5e-5  # m: rounding of reported poses
JOINT_COLUMNS = ('joint', 'zero offset', 'axis direction', 'axis position', 'not known')
MODEL_COLUMNS = ('model', 'residual RMS', 'left out RMS', 'left out median', '')
HEADER = """\
# Errors of the joints and axes of an arm, found with the hand-eye transform in calibration.yaml.
# offset is added to the joint's reading; direction (rad) and position (m) turn and shift its axis
# across itself. covariance: of all these values, in their order; configurations: joint values of
# which they were found. known: sigma after over sigma before; {limit} or more: not determined.
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
        """Return the answer; inputs: path and sha256 of all files; warnings: of reading them."""
        provenance = {**calibration.provenance, 'inputs': list(inputs)}
        return cls(outcome, replace(calibration, provenance=provenance),
                   (*warnings, *outcome.warnings))

    @property
    def arm(self) -> Arm:
        """Return the arm with its errors."""
        return self.outcome.arm

    @property
    def sentence(self) -> str:
        """Return the gain in accuracy, and the remaining error, in words."""
        stated, corrected = self.outcome.models[0], self.outcome.chosen
        return (f'points that were left out: {stated.left_out_rms * 1e3:.2f} mm RMS before, '
                f'{corrected.left_out_rms * 1e3:.2f} mm after; what is left of the error of the '
                f'robot: {self.outcome.smooth * 1e3:.2f} mm (RMS, each axis)')

    def save(self, urdf: str, folder: Path, formats: Sequence[str]) -> str:
        """
        Write calibration.yaml, kinematics.yaml and corrected.urdf; return their paths.

        urdf: the stated one of the robot. The calibration names the kinematics file.
        """
        folder = folder.absolute()
        provenance = self.calibration.provenance
        read_with = {**provenance['config'], 'kinematics': str(folder / NAME)}
        calibration = replace(self.calibration, provenance={**provenance, 'config': read_with})
        saved = exports.save_all(calibration, folder, formats)
        write_whole(folder / NAME, _text(self))
        write_whole(folder / URDF, corrected_urdf(urdf, self.arm))
        return f'{saved}, {NAME}, {URDF}'


def solve_table(path: Path, chain: Chain, config: Config, inputs: Sequence[dict[str, str]]
                ) -> Answer:
    """
    Return the corrected arm from a table of joint values and points (points.read_table).

    inputs: path and sha256 of the files. Raises HandeyeError.
    """
    data, notes = read_table(path, chain, config.calibration_type == 'eye_in_hand')
    outcome = solve_points(data, chain, config.limits.residual)
    reported = () if data.reported is None else (
        compared(data.reported, chain.forward(data.q)),)
    return Answer.of(outcome, _calibration(outcome, data, config), inputs, (*notes, *reported))


def _calibration(outcome: Outcome, data: Points, config: Config) -> Calibration:
    """Return the hand-eye transform found from points, as a Calibration."""
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


def _text(answer: Answer) -> str:
    """Return the contents of kinematics.yaml."""
    outcome, arm, calibration = answer.outcome, answer.arm, answer.calibration
    provenance = {'version': __version__,
                  'created': datetime.now(UTC).isoformat(timespec='seconds'),
                  **calibration.provenance, 'warnings': list(answer.warnings)}
    content = {
        'format': f'{FORMAT}1', 'name': calibration.name, 'base': arm.chain.base,
        'flange': arm.chain.flange, 'joints': _joints(outcome),
        'end': transform_values(arm.chain.end),
        'zero_offsets_degrees': {
            j.name: round(math.degrees(float(arm.of(i, OFFSET)[0])), 5)
            for i, j in enumerate(arm.chain.joints) if j.kind == REVOLUTE},
        'transform': transform_values(calibration.T_flange_sensor),
        'models': [{'parameters': list(m.kinds), 'residual_rms': m.fit.noise_rms,
                    'left_out_rms': m.left_out_rms, 'left_out_median': m.left_out_median,
                    'chosen': m is outcome.chosen} for m in outcome.models],
        'robot_smooth_error': outcome.smooth,
        'covariance': _covariance(outcome).tolist(),
        'configurations': outcome.chosen.fit.data.q[:MOST_CONFIGURATIONS].round(6).tolist(),
        'provenance': provenance}
    return HEADER.format(limit=UNKNOWN) + str(yaml.safe_dump(
        content, sort_keys=False, width=100, default_flow_style=None, allow_unicode=True))


def _covariance(outcome: Outcome) -> Array:
    """Return the covariance (k, k) of the parameters in the order of the file."""
    parameters, first = outcome.arm.parameters, outcome.chosen.fit.data.unknowns
    rows = [first + k for k in sorted(range(len(parameters)), key=lambda k: (
        parameters[k].joint, list(COUNTS).index(parameters[k].kind), parameters[k].index))]
    return outcome.covariance[np.ix_(rows, rows)]


def _joints(outcome: Outcome) -> list[dict[str, Any]]:
    arm, entries = outcome.arm, []
    columns = {'value': arm.values, 'std': outcome.stds, 'known': outcome.sigma_ratios}
    for i, joint in enumerate(arm.chain.joints):
        values: dict[str, Any] = {
            'name': joint.name, 'type': joint.kind, 'origin': transform_values(joint.origin),
            'axis': joint.axis.tolist(), 'follows': joint.follows, 'factor': joint.factor,
            'shift': joint.shift, 'lower': joint.lower, 'upper': joint.upper}
        for kind in dict.fromkeys(p.kind for p in arm.parameters):
            rows = [k for k, p in enumerate(arm.parameters) if (p.joint, p.kind) == (i, kind)]
            if rows:
                values[kind] = {key: array[rows].tolist() for key, array in columns.items()}
        entries.append(values)
    return entries


def compared(reported: Array, nominal: Array) -> str:
    """Return in words how reported poses (n, 4, 4) differ from those of the URDF."""
    distances = np.linalg.norm(reported[:, :3, 3] - nominal[:, :3, 3], axis=1)
    angles = se3.angle(reported[:, :3, :3] @ np.swapaxes(nominal[:, :3, :3], 1, 2))
    if distances.max() > OTHER_FRAMES or angles.max() > OTHER_FRAMES:
        return ('the reported poses are of other frames than base and flange of the URDF, and are '
                'not compared; the joint values are used')
    if distances.max() < EQUAL:
        return 'the controller and the URDF have the same kinematics'
    return (f'the controller does not have the kinematics of the URDF: its poses differ by '
            f'{np.sqrt((distances ** 2).mean()) * 1e3:.2f} mm RMS, {distances.max() * 1e3:.2f} mm '
            'at most; the joint values are used')


def table(answer: Answer) -> RenderableType:
    """Return the joints with their errors, and the cross-validation error of each model."""
    tables = []
    for header, *rows in (_joint_rows(answer), _model_rows(answer)):
        tables.append(Table(*header, box=box.SIMPLE_HEAD, pad_edge=False))
        for row in rows:
            tables[-1].add_row(*row)
    return Group(Text('Zero offset: add it to the reading of the joint.'), *tables,
                 Text(answer.sentence))


def _joint_rows(answer: Answer) -> Iterator[tuple[str, ...]]:
    yield JOINT_COLUMNS
    for i, joint in enumerate(answer.arm.chain.joints):
        zero = (math.degrees(1), 4, 'deg') if joint.kind == REVOLUTE else (1e3, 3, 'mm')
        yield (joint.name, _cell(answer, i, OFFSET, *zero),
               _cell(answer, i, DIRECTION, math.degrees(1), 4, 'deg'),
               _cell(answer, i, POSITION, 1e3, 3, 'mm'), ', '.join(_unknown(answer, i)))


def _model_rows(answer: Answer) -> Iterator[tuple[str, ...]]:
    yield MODEL_COLUMNS
    for model in answer.outcome.models:
        yield (model.words, *(f'{v * 1e3:.3f} mm' for v in (
            model.fit.noise_rms, model.left_out_rms, model.left_out_median)),
            'the answer' if model is answer.outcome.chosen else '')


def _unknown(answer: Answer, joint: int) -> Iterator[str]:
    """Yield the kinds of errors of a joint that the data do not determine."""
    unknown_kinds: dict[str, list[bool]] = {}
    for p, ratio in zip(answer.arm.parameters, answer.outcome.sigma_ratios, strict=True):
        if p.joint == joint:
            unknown_kinds.setdefault(p.kind, []).append(ratio > UNKNOWN)
    yield from (kind for kind, uncertain in unknown_kinds.items() if all(uncertain))


def _cell(answer: Answer, joint: int, kind: str, factor: float, digits: int, unit: str) -> str:
    values = [(value, std) for p, value, std in zip(
        answer.arm.parameters, answer.arm.values, answer.outcome.stds, strict=True)
        if (p.joint, p.kind) == (joint, kind)]
    cells = [f'{value * factor:+.{digits}f} ± {std * factor:.{digits}f}' for value, std in values]
    return f'{", ".join(cells)} {unit}' if cells else '-'
