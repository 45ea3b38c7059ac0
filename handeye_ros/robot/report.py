# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The corrected arm on the screen: degrees and mm, with 1 sigma."""
from __future__ import annotations

from collections.abc import Iterator
import math

from handeye_ros.robot.answer import Answer, UNKNOWN
from handeye_ros.robot.model import DIRECTION, OFFSET, POSITION, REVOLUTE
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

JOINT_COLUMNS = ('joint', 'zero offset', 'axis direction', 'axis position', 'not known')
MODEL_COLUMNS = ('model', 'residual RMS', 'left out RMS', 'left out median', '')


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
