# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Tables of a calibration: millimetres and degrees, each with its unit and 1 sigma; words."""
from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
import math
import re
from typing import Any

from handeye_ros import se3
from handeye_ros.config import RECORD_PREFIX
from handeye_ros.data import (
    Array,
    BudgetTerm,
    Calibration,
    Reject,
    ROBOT_POSITION_ERROR,
    Sample,
)
from handeye_ros.frames import weakest_position
from handeye_ros.results.truth import FIELD_TEXT, TransformErrors
from handeye_ros.words import count_of, without_numbers
import numpy as np
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

FOUND_MM = '{} mm (1 sigma, found and allowed for)'
FOUND_DEGREES = '{} degrees (1 sigma, found and allowed for)'
# How estimates are shown: a pattern of their keys, the label ('': that of the key), the words
# around the value, the factor to the unit in these words, and the number of digits.
ESTIMATES = (
    ('(centre|point|radius|distance|size|setback).*', '', '{} mm', 1e3, 3),
    ('.*angle', '', '{} degrees', math.degrees(1), 4),
    ('normal.*|direction', '', '{}', 1.0, 6),
    ('rotation_lag', 'robot, rotation', '{} ms later than the position', 1e3, 3),
    ('clock_drift', 'clocks', '{} ms a minute apart', 60e3, 2),
    ('scale', 'lengths', 'of the robot {} times those of the sensor', 1.0, 5),
    (ROBOT_POSITION_ERROR, 'robot, smooth error', FOUND_MM, 1e3, 4),
    ('tracking_position_error', 'robot, error in motion', FOUND_MM, 1e3, 4),
    ('tracking_rotation_error', 'robot, turn in motion', FOUND_DEGREES, math.degrees(1), 4),
    ('distortion_error', 'sensor, bent field', FOUND_MM, 1e3, 4),
    ('line_bend', 'sensor, bent laser line', FOUND_MM, 1e3, 4),
    ('flatness_error', 'target, flatness', FOUND_MM, 1e3, 4),
)


def table(calibration: Calibration) -> RenderableType:
    """Return the table of a calibration, for a rich console."""
    parent, child = calibration.parent_frame, calibration.child_frame
    title = Text(f'{calibration.name}: {child} in {parent}. T maps points of {child} into '
                 f'{parent}: p_{parent} = T @ p_{child}')
    numbers = figures_table('', 'value', '1 sigma', '', rows=transform_rows(calibration),
                            right=(1, 2))
    others = Table(box=None, show_header=False, pad_edge=False)
    for name, fact in (*facts(calibration), *details(calibration.target)):
        others.add_row(name, Text(fact))
    return Group(title, numbers, others)


def figures_table(*heads: str, rows: Iterable[Iterable[str]] = (), right: Container[int] = (),
                  title: str | None = None) -> Table:
    """Return a table of texts; right: numbers of the columns of figures, which never wrap."""
    table = Table(title=title, title_justify='left', box=box.SIMPLE_HEAD, pad_edge=False)
    for k, head in enumerate(heads):
        table.add_column(Text(head), justify='right' if k in right else 'left',
                         no_wrap=k in right, overflow='fold')
    for row in rows:
        table.add_row(*map(Text, row))
    return table


def budget_table(terms: Sequence[BudgetTerm], samples: int) -> RenderableType:
    """Return the table of what the uncertainty comes from; the last of the terms is their sum."""
    rows = ((term.name, f'{100 * (term.mapped / terms[-1].mapped) ** 2:.1f} %',
             f'{1e3 * term.mapped:.4f} mm', f'{1e3 * term.translation:.4f} mm',
             f'{math.degrees(term.rotation):.4f} degrees') for term in terms)
    causes = figures_table('1 sigma by cause', 'share', 'mapped points', 'position', 'rotation',
                           rows=rows, right=range(1, 5))
    return Group(causes, Text(f'squares add up; {samples} samples; mapped points: RMS over '
                              'nine points of the\npart of the view that the samples show; '
                              'position, rotation: RMS of the axes'))


def transform_rows(calibration: Calibration) -> Iterator[tuple[str, str, str, str]]:
    """Yield name, value, 1 sigma and unit of the six numbers of a transform."""
    T, covariance = calibration.T_flange_sensor, calibration.covariance
    for axis, value, std in zip('xyz', T[:3, 3], np.sqrt(np.diag(covariance))[:3], strict=True):
        yield axis, f'{value * 1e3:.3f}', f'{std * 1e3:.3f}', 'mm'
    stds = rpy_std(T, covariance[3:, 3:])
    for name, angle, std in zip(('roll', 'pitch', 'yaw'), se3.rpy(T), stds, strict=True):
        yield (name, f'{math.degrees(angle):.4f}',
               f'{math.degrees(std):.4f}' if math.isfinite(std) else 'undefined', 'degrees')


def rpy_std(T: Array, covariance: Array) -> Array:
    """
    Return the 1 sigma (3,) of roll, pitch and yaw (radians).

    covariance: (3, 3) of the rotation vector in the parent frame. Infinite where the pitch
    is so close to 90 degrees that roll and yaw turn about one axis.
    """
    _, pitch, yaw = se3.rpy(T)
    if abs(math.cos(pitch)) < 1e-3:
        return np.full(3, math.inf)
    turned_y = [-math.sin(yaw), math.cos(yaw), 0.0]
    to_rpy = np.linalg.inv(np.column_stack([T[:3, 0], turned_y, [0.0, 0.0, 1.0]]))
    return np.asarray(np.sqrt(np.diag(to_rpy @ covariance @ to_rpy.T)))


def facts(calibration: Calibration) -> Iterator[tuple[str, str]]:
    """Yield name and text of each other fact, such as the method and the samples."""
    quality = calibration.quality
    quaternion = se3.quaternion(calibration.T_flange_sensor)
    yield 'quaternion', ' '.join(f'{q:.9f}' for q in quaternion) + '  (x y z w)'
    yield 'method', calibration.method
    yield 'residual', f'{quality.residual_rms * 1e3:.3f} mm RMS'
    yield 'left out', f'{quality.holdout_rms * 1e3:.3f} mm RMS (each sample predicted from ' \
                      'the others)'
    yield 'weakest', weakest(calibration)
    yield 'samples', f'{quality.samples_used} used, {quality.samples_rejected} rejected'
    reasons = [sample.reason or 'no reason given' for sample in calibration.samples
               if not sample.used]
    for cause, count in Counter(map(without_numbers, reasons)).items():
        first = next(reason for reason in reasons if without_numbers(reason) == cause)
        yield '', f'{count} rejected{", the first" if count > 1 else ""}: {first}'
    if offset := calibration.time_offset:
        yield 'time offset', (f'{offset.value * 1e3:.3f} ms, 1 sigma {offset.std * 1e3:.3f} '
                              '(to be added to the stamps of the profiles)')
    config = calibration.provenance.get('config') or {}
    if arm := config.get('kinematics'):
        yield 'poses', f'of the corrected arm in {arm}; with those of the controller it is wrong'
    for key, text in config.items():
        if key.startswith(RECORD_PREFIX):
            yield key.removeprefix(RECORD_PREFIX).replace('_', ' '), str(text)


def weakest(calibration: Calibration) -> str:
    """Return where the position is least certain, in words."""
    words, std = weakest_position(calibration.covariance, calibration.parent_frame)
    return f'{words}: {std * 1e3:.3f} mm (1 sigma)'


def details(target: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield name and text (mm, degrees) of each estimate of target, sensor and robot."""
    for key, value in target.items():
        shown = next((row for row in ESTIMATES if re.fullmatch(row[0], str(key))), None)
        name = f'target {str(key).replace("_", " ")}'
        if key == 'pose':
            T = se3.transform_from_values(value)
            x, y, z = 1e3 * T[:3, 3]
            yield f'{name}, x y z', f'{x:.3f} {y:.3f} {z:.3f} mm'
            roll, pitch, yaw = np.degrees(se3.rpy(T))
            yield f'{name}, rpy', f'{roll:.4f} {pitch:.4f} {yaw:.4f} degrees'
        elif key.endswith('_std') or key == 'joint':
            continue
        elif shown and not isinstance(value, str):
            _, label, words, factor, digits = shown
            std = target.get(f'{key}_std')
            numbers = value.values() if isinstance(value, Mapping) else np.atleast_1d(value)
            text = words.format(' '.join(f'{v * factor:.{digits}f}' for v in numbers))
            sigma = '' if std is None else (
                f', 1 sigma {std * factor:.{digits}f}' if std else ', given')
            yield label or name, text + sigma
        else:
            yield name, str(value)


def error_sentence(errors: TransformErrors, region: str = FIELD_TEXT) -> str:
    """Return the errors against the truth in words; region: the points that are mapped."""
    return (f'error against truth.yaml: translation {errors.translation * 1e3:.3f} mm, rotation '
            f'{math.degrees(errors.rotation):.4f} degrees, mapped points '
            f'{errors.mapped_points * 1e3:.3f} mm RMS over {region}')


def sample_summary(sample: Sample | Reject) -> str:
    """Return what a sample shows, or why there is none, in words."""
    if isinstance(sample, Reject):
        return sample.reason
    counts = Counter(feature.noun for feature in sample.features)
    seen = ', '.join(count_of(count, name) for name, count in counts.items())
    return f'{seen} from {count_of(sample.profile_count, "profile")}'
