# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The calibrations of a folder over time: each compared with the first and the last one."""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from handeye_ros import output, se3
from handeye_ros.data import Array, Calibration
from handeye_ros.errors import DataError, InputError
from handeye_ros.estimation.least_squares import chi2_isf, chi2_sf
from handeye_ros.results.calibration_file import read_calibration
from handeye_ros.verification.verify import time_of
import numpy as np
from rich.markup import escape
from rich.table import Table

CHANGED, WARNING = 0.01, 0.05  # p-values of a difference: act, watch


@dataclass(frozen=True, eq=False)
class Entry:
    """
    One calibration of a trend.

    recorded: time of its first sample, or of its file where that is unknown. difference: (6,) to
    the first, std: (6,) of it, by both covariances; p_first, p_before: p-values of the difference
    to the first, and to the previous one. residual: RMS (m).
    """

    path: Path
    recorded: str
    difference: Array
    std: Array
    p_first: float
    p_before: float
    residual: float


def trend(folder: Path, first: Calibration | None = None, files: Iterable[Path] | None = None
          ) -> tuple[list[Entry], list[str]]:
    """
    Return the calibrations below a folder by time, and a warning for each file left out.

    first: the reference, the oldest if not given. files: of the folder, all calibration.yaml if
    not given. Raises DataError for too few.
    """
    calibrations, warnings = [], []
    for path in sorted(folder.rglob('calibration.yaml') if files is None else files):
        try:
            calibration = read_calibration(path)
        except InputError as error:
            warnings.append(str(error))
            continue
        calibrations.append((_recorded(calibration), path, calibration))
    calibrations.sort(key=lambda item: (item[0], str(item[1])))
    if len(calibrations) < 2 - (first is not None):
        raise DataError(f'{folder} holds {len(calibrations)} readable calibration.yaml: a trend '
                        'needs two, or one with --against')
    reference = first or calibrations[0][2]
    entries, previous = [], reference
    for recorded, path, calibration in calibrations:
        difference, C = between(calibration, reference)
        entries.append(Entry(path, recorded, difference, np.sqrt(np.diag(C)),
                             _p(difference, C), _p(*between(calibration, previous)),
                             calibration.quality.residual_rms))
        previous = calibration
    return entries, warnings


def _recorded(calibration: Calibration) -> str:
    """Return the time of a calibration: of its samples, else of its solution."""
    stamp = min((report.stamp for report in calibration.samples), default=0)
    return time_of(stamp) or str(calibration.provenance.get('created', ''))


def between(a: Calibration, b: Calibration) -> tuple[Array, Array]:
    """Return the difference of a from b (6,), and its covariance; zero for the same one."""
    difference = se3.difference(a.T_flange_sensor, b.T_flange_sensor)
    return difference, a.covariance + b.covariance


def _p(difference: Array, C: Array) -> float:
    return float(chi2_sf(difference @ np.linalg.solve(C, difference), 6))


def table(entries: Sequence[Entry]) -> Table:
    """Return the trend as a table."""
    result = Table(title='differences from the first', title_justify='left')
    for column in ('recorded', 'x [mm]', 'y [mm]', 'z [mm]', 'rotation [degrees]',
                   'p to the first', 'p to the previous', ''):
        result.add_column(escape(column), justify='right')  # [mm] is no markup
    for e in entries:
        note = ('CHANGED' if e.p_before < CHANGED else
                'watch' if min(e.p_before, e.p_first) < WARNING else '')
        result.add_row(e.recorded, *(f'{v * 1e3:.3f}' for v in e.difference[:3]),
                       f'{np.degrees(np.linalg.norm(e.difference[3:])):.4f}', f'{e.p_first:.3g}',
                       f'{e.p_before:.3g}', note)
    return result


def since_when(entries: Sequence[Entry]) -> str:
    """Return a sentence on the first change between consecutive calibrations."""
    for e in entries:
        if e.p_before < CHANGED:
            return f'the calibration changed between {e.recorded or e.path} and the previous one'
    return 'no calibration differs from the previous one by more than their uncertainties explain'


def draw(entries: Sequence[Entry], path: Path) -> None:
    """
    Write a picture of the trend: differences from the first, and the residuals.

    The bars are the joint 95 % region of all six differences. Raises NoMatplotlibError,
    UnwritableError.
    """
    drawing, axes = output.figure(3, 1)
    index = np.arange(len(entries))
    difference = np.array([e.difference for e in entries])
    reach = float(np.sqrt(chi2_isf(WARNING, 6))) * np.array([e.std for e in entries])
    for ax, axes_slice, scale, unit in ((axes[0], slice(0, 3), 1e3, 'mm'),
                                        (axes[1], slice(3, 6), 180 / np.pi, 'degrees')):
        for k, name in enumerate('xyz'):
            ax.errorbar(index + 0.05 * (k - 1), scale * difference[:, axes_slice][:, k],
                        scale * reach[:, axes_slice][:, k], fmt='o-', capsize=3,
                        label=name if unit == 'mm' else f'about {name}')
        ax.set_ylabel(f'difference [{unit}], joint 95 %')
        ax.axhline(0, color='0.7', linewidth=0.8)
        for boundary in np.flatnonzero([e.p_before < CHANGED for e in entries]) - 0.5:
            ax.axvline(boundary, color='tab:red', linestyle='--', linewidth=1)
            ax.annotate('changed', (boundary, 1), xycoords=('data', 'axes fraction'), fontsize=8,
                        color='tab:red', va='bottom', ha='center')
        ax.legend(fontsize=8)
        ax.set_xticks(index, [])  # the dates stand below the last
    axes[2].plot(index, [1e3 * e.residual for e in entries], 'o-', markersize=4)
    axes[2].set_ylabel('residual RMS [mm]')
    axes[2].set_xticks(index, [e.recorded[:16] or e.path.parent.name for e in entries],
                       rotation=20, ha='right', fontsize=8)
    output.save(drawing, path)


def csv_text(entries: Sequence[Entry]) -> str:
    """Return the trend as CSV: metres and radians."""
    axes = ('x', 'y', 'z', 'rx', 'ry', 'rz')
    return output.csv_text(
        ('recorded', 'path', *axes, *(f'{axis}_std' for axis in axes), 'p_first', 'p_before',
         'residual'),
        ((e.recorded, e.path, *e.difference, *e.std, e.p_first, e.p_before, e.residual)
         for e in entries))
