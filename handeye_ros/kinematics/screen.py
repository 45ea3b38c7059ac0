"""The corrected arm for a person: degrees and millimetres, each with its 1 sigma."""
from __future__ import annotations

from collections.abc import Iterator
import math

from handeye_ros.kinematics.answer import Answer, UNKNOWN
from handeye_ros.kinematics.chain import REVOLUTE
from handeye_ros.kinematics.model import DIRECTION, OFFSET, POSITION
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text


def table(answer: Answer) -> RenderableType:
    """Return the joints with their errors, and how well each model predicts left-out points."""
    joints = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ('joint', 'zero offset', 'axis direction', 'axis position', 'not known'):
        joints.add_column(name)
    for i, joint in enumerate(answer.arm.chain.joints):
        zero = (math.degrees(1), 4, 'deg') if joint.kind == REVOLUTE else (1e3, 3, 'mm')
        joints.add_row(joint.name, _cell(answer, i, OFFSET, *zero),
                       _cell(answer, i, DIRECTION, math.degrees(1), 4, 'deg'),
                       _cell(answer, i, POSITION, 1e3, 3, 'mm'), ', '.join(unknown(answer, i)))
    models = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ('model', 'residual RMS', 'left out RMS', 'left out median', ''):
        models.add_column(name)
    for k, model in enumerate(answer.models):
        models.add_row(model.words, *(f'{v * 1e3:.3f} mm' for v in (
            model.residual, model.left_out, model.left_out_median)),
            'the answer' if k == answer.chosen else '')
    return Group(Text('Zero offset: add it to the reading of the joint.'), joints, models,
                 Text(sentence(answer)))


def sentence(answer: Answer) -> str:
    """Return what is gained, and what is left."""
    before, after = answer.models[0], answer.models[answer.chosen]
    return (f'points that were left out: {before.left_out * 1e3:.2f} mm RMS before, '
            f'{after.left_out * 1e3:.2f} mm after; what is left of the error of the robot: '
            f'{answer.smooth * 1e3:.2f} mm (RMS, each axis)')


def unknown(answer: Answer, joint: int) -> Iterator[str]:
    """Yield the kinds of errors of a joint of which the data tell next to nothing."""
    found: dict[str, list[bool]] = {}
    for p, ratio in zip(answer.arm.parameters, answer.known, strict=True):
        if p.joint == joint:
            found.setdefault(p.kind, []).append(ratio > UNKNOWN)
    yield from (kind for kind, each in found.items() if all(each))


def _cell(answer: Answer, joint: int, kind: str, factor: float, digits: int, unit: str) -> str:
    values = [(value, std) for p, value, std in zip(
        answer.arm.parameters, answer.arm.values, answer.stds, strict=True)
        if (p.joint, p.kind) == (joint, kind)]
    cells = [f'{value * factor:+.{digits}f} ± {std * factor:.{digits}f}' for value, std in values]
    return f'{", ".join(cells)} {unit}' if cells else '-'
