# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The calibrations of a folder over time: each compared with a reference and the previous one.

The reference is the oldest, or that of --against.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path

from handeye_ros import output, se3
from handeye_ros.data import Array, Calibration
from handeye_ros.errors import DataError, InputError
from handeye_ros.estimation.least_squares import chi2_sf
from handeye_ros.results.calibration_file import NAME, read_calibration
from handeye_ros.results.printed import figures_table
from handeye_ros.se3 import AXES
import numpy as np
from rich.table import Table

CHANGED_P, WATCH_P = 0.01, 0.05  # p-values of a difference: act, watch


@dataclass(frozen=True, eq=False)
class TrendEntry:
    """
    One calibration of a trend.

    recorded: time of its first sample, or of its solution where that is unknown
    difference: (6,) from the reference, as x y z rx ry rz (m, rad)
    std: (6,) 1 sigma of the difference, by both covariances
    p_reference: p-value of the difference from the reference
    p_before: p-value of the difference from the previous one; of the first from the reference
    residual: RMS residual of its samples (m)
    """

    path: Path
    recorded: str
    difference: Array
    std: Array
    p_reference: float
    p_before: float
    residual: float


def trend(folder: Path, against: Calibration | None = None) -> tuple[list[TrendEntry], list[str]]:
    """
    Return the calibrations below a folder by time, and a warning for each file not used.

    against: the reference, the oldest if not given; only those between its frames are compared.
    Raises DataError where fewer than two (with against: one) are between its frames, and
    InputError for a folder without any readable one.
    """
    if not folder.is_dir():
        raise InputError(f'there is no folder {folder}: name one that holds calibrations')
    calibrations, warnings = _dated_below(folder)
    if not calibrations:
        raise InputError(f'{folder} holds 0 readable calibration.yaml: a trend needs two, or one '
                         'with --against')
    reference = before = against or calibrations[0][-1]
    entries = []
    for recorded, _, path, calibration in calibrations:
        if _frames(calibration) != _frames(reference):
            warnings.append(f'{path} is not used: it is of {_frames(calibration)}, not of '
                            f'{_frames(reference)}; name another reference with --against')
            continue
        difference, std, p_reference = difference_of(calibration, reference)
        _, _, p_before = difference_of(calibration, before)
        entries.append(TrendEntry(path, recorded, difference, std, p_reference, p_before,
                                  calibration.quality.residual_rms))
        before = calibration
    if len(entries) < 2 - (against is not None):
        raise DataError(f'{folder} holds {len(entries)} readable calibration.yaml of '
                        f'{_frames(reference)}: a trend needs two, or one with --against')
    return entries, warnings


def _dated_below(folder: Path) -> tuple[list[tuple[str, str, Path, Calibration]], list[str]]:
    """
    Return the usable calibrations below a folder by time, and a warning for each other file.

    With the times of recording and of solution, and the path.
    """
    found, warnings = [], []
    for path in sorted(folder.rglob(NAME)):
        try:
            calibration = read_calibration(path)
        except InputError as error:
            warnings.append(str(error))
            continue
        if np.linalg.eigvalsh(calibration.covariance)[0] <= 0:
            warnings.append(f'{path} is not used: its covariance is not positive definite')
            continue
        stamp = min((report.stamp for report in calibration.samples), default=0)
        created = str(calibration.provenance.get('created', ''))
        found.append((output.iso_time(stamp) or created, created, path, calibration))
    return sorted(found, key=itemgetter(0, 1)), warnings  # of one time by path


def _frames(calibration: Calibration) -> str:
    return f'{calibration.child_frame} on {calibration.parent_frame}'


def difference_of(a: Calibration, b: Calibration) -> tuple[Array, Array, float]:
    """Return the difference (6,) of a from b (m, rad), its 1 sigma (6,) and its p-value."""
    difference = se3.difference(a.T_flange_sensor, b.T_flange_sensor)
    covariance = a.covariance + b.covariance
    p_value = float(chi2_sf(difference @ np.linalg.solve(covariance, difference), 6))
    return difference, np.sqrt(np.diag(covariance)), p_value


def table(entries: Sequence[TrendEntry]) -> Table:
    """Return the trend as a table."""
    rows = []
    for entry in entries:
        shift, turn = np.split(entry.difference, 2)
        least = min(entry.p_reference, entry.p_before)
        rows.append((
            entry.recorded, *(f'{metres * 1e3:.3f}' for metres in shift),
            f'{np.degrees(np.linalg.norm(turn)):.4f}', f'{entry.p_reference:.3g}',
            f'{entry.p_before:.3g}',
            'CHANGED' if least < CHANGED_P else 'watch' if least < WATCH_P else '',
            str(entry.path.parent)))
    return figures_table(
        'recorded', 'x\n[mm]', 'y\n[mm]', 'z\n[mm]', 'rotation\n[degrees]', 'p to the\nreference',
        'p to the\nprevious', '', 'folder', rows=rows, right=range(1, 7),
        title='differences from the reference')


def since_when(entries: Sequence[TrendEntry]) -> str:
    """Return a sentence on the first change, else on the first difference from the reference."""
    for entry in entries:
        if entry.p_before < CHANGED_P:
            other = 'the reference' if entry is entries[0] else 'the previous one'
            return f'the calibration changed between {entry.recorded or entry.path} and {other}'
    for entry in entries:
        if entry.p_reference < CHANGED_P:
            return (f'the calibration drifted: {entry.recorded or entry.path} differs from the '
                    'reference, and none from its previous one')
    return 'no calibration differs from the previous one by more than their uncertainties explain'


def csv_text(entries: Sequence[TrendEntry]) -> str:
    """Return the trend as CSV, in metres and radians."""
    return output.csv_text(
        ('recorded', 'path', *AXES, *(f'{axis}_std' for axis in AXES), 'p_reference',
         'p_before', 'residual'),
        ((entry.recorded, entry.path, *entry.difference, *entry.std, entry.p_reference,
          entry.p_before, entry.residual) for entry in entries))
