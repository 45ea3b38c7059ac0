# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Tables in CSV files.

The header names each column and, where it has one, its unit: `base_x [mm]`. What is returned is
in SI units.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
import csv
import math
from pathlib import Path
import re

from handeye_ros import se3
from handeye_ros.data import Array, QUATERNION_TOLERANCE
from handeye_ros.errors import DataError, did_you_mean, InputError
from handeye_ros.notations import Notation, notation_of, NOTATIONS, QUATERNION, RPY
from handeye_ros.units import MICRO, UNITS
from handeye_ros.words import count_of
import numpy as np

LENGTH, ANGLE, NUMBER = 'm', 'rad', ''  # kinds of columns, by their SI unit
SPELLINGS = {'degree': 'deg', '°': 'deg', 'radian': 'rad', 'radians': 'rad', 'metre': 'm',
             'metres': 'm', 'meter': 'm', 'meters': 'm', 'millimetres': 'mm',
             'millimeters': 'mm'}
MAX_VALUE = 1e6  # m or rad: more is a mistake
_HEADER = re.compile(r'\s*([\w.:/-]+)\s*(?:\[\s*(\w+|°)\s*\])?\s*')  # name [unit]


class TableError(InputError):
    """A table that cannot be read, or does not hold what is needed."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path}: {reason}')


class CsvTable:
    """
    The columns of a CSV file.

    columns: by name, the unit ('' without one) and the text of each row
    """

    def __init__(self, path: Path) -> None:
        """Read a CSV file; commas or semicolons separate the values. Raises TableError."""
        self.path = path
        if path.is_dir():
            raise TableError(path, 'is a folder; give the file in it, or, if it is a '
                             'recording, set target.type to the target that it shows')
        try:
            lines = [line for line in path.read_text(encoding='utf-8-sig').splitlines()
                     if line.strip() and not line.startswith('#')]
            delimiter = ';' if ';' in ''.join(lines[:1]) else ','
            header, *rows = [*csv.reader(lines, delimiter=delimiter)] or [[]]
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise TableError(path, f'cannot be read as CSV: {error}') from error
        units = dict[str, str]()
        for cell in header:
            match = _HEADER.fullmatch(cell)
            if not match:
                raise TableError(path, f'cannot read the column header "{cell}"; expected a name '
                                 'with its unit, such as base_x [mm]')
            unit = MICRO.sub('u', match[2] or '')
            units[match[1]] = SPELLINGS.get(unit, unit)
        if len(units) != len(header):
            raise TableError(path, 'two columns have the same name')
        if not rows:
            raise TableError(path, 'holds no rows' if header else 'is empty')
        for number, row in enumerate(rows, 1):
            if len(row) != len(header):
                raise TableError(path, f'row {number} has {count_of(len(row), "value")}, the '
                                 f'header {len(header)}')
        self.columns = {name: (unit, texts) for (name, unit), texts in zip(
            units.items(), zip(*rows, strict=True), strict=True)}

    def renamed(self, names: Mapping[str, str]) -> CsvTable:
        """Return the table with other names of some columns; their units stay."""
        other = copy(self)
        other.columns = {names.get(name, name): column for name, column in self.columns.items()}
        return other

    def texts(self, name: str) -> list[str]:
        """
        Return the texts (n) of a column without surrounding blanks.

        Raises TableError for a missing column.
        """
        self._require([name])
        return [value.strip() for value in self.columns[name][1]]

    def values(self, names: Sequence[str], kind: str, unit: str = '') -> Array:
        """
        Return the columns `names` as numbers (n, k) in SI units.

        kind: LENGTH, ANGLE or NUMBER. unit: assumed where the header states none; if it is empty
        too, lengths and angles are refused. Raises TableError.
        """
        self._require(names)
        return np.column_stack([self._values(name, kind, unit) for name in names])

    def points(self, prefix: str) -> Array:
        """
        Return the points (n, 3) in the columns PREFIX_x, PREFIX_y, PREFIX_z (m).

        Raises TableError.
        """
        return self.values(_axes(prefix), LENGTH)

    def notation(self, prefix: str, angles: str = '') -> Notation:
        """
        Return how orientations are written: as stated, or by the names of the columns.

        Raises UnknownNameError for a notation that does not exist.
        """
        if angles:
            return notation_of(angles)
        return RPY if self.columns.keys() >= {*RPY.columns(prefix)} else QUATERNION

    def poses(self, prefix: str, angles: str = '') -> Array:
        """
        Return transforms (n, 4, 4): the translation as points, the rotation as a quaternion.

        Columns PREFIX_qx, _qy, _qz, _qw, or PREFIX_roll, _pitch, _yaw (URDF); or, with the name
        of a notation, those of a controller (PREFIX_a, _b, _c of KUKA), in its units where the
        header says none. Raises TableError, and UnknownNameError for the notation.
        """
        notation = self.notation(prefix, angles)
        names, axes = notation.columns(prefix), _axes(prefix)
        readable = [name for name, other in {**NOTATIONS, '': self.notation(prefix)}.items()
                    if self.columns.keys() >= {*other.columns(prefix)}]
        if readable and not self.columns.keys() >= {*names}:
            how = (f'--angles {" or ".join(readable)} reads, of the flange only' if all(readable)
                   else 'are read without --angles')
            raise TableError(self.path, f'has no columns {", ".join(names)}; it has those that '
                             f'{how}')
        self._require([*axes, *names])
        kind = ANGLE if notation.angle_unit else NUMBER
        length, unit = (notation.length_unit, notation.angle_unit) if angles else ('', '')
        numbers = self.values(names, kind, unit) / UNITS[kind][notation.angle_unit]
        length_errors = np.abs(np.linalg.norm(numbers, axis=1) - 1.0)
        if kind == NUMBER and length_errors.max() > QUATERNION_TOLERANCE:
            raise TableError(self.path, f'row {int(np.argmax(length_errors)) + 1}: {prefix}_q... '
                             'is no unit quaternion')
        return se3.transform(notation.to_rotation(numbers).as_matrix(),
                             self.values(axes, LENGTH, length))

    def _require(self, names: Sequence[str]) -> None:
        """Raise TableError for a missing column, with a similar name that is not among names."""
        for name in names:
            if name not in self.columns:
                others = [other for other in self.columns if other not in names]
                raise TableError(self.path, f'has no column {name}{did_you_mean(name, others)}')

    def _values(self, name: str, kind: str, default: str) -> Array:
        """Return a column (n,) in its SI unit; raises TableError."""
        stated, texts = self.columns[name]
        unit, factors = stated or default, UNITS[kind]
        if unit not in factors:
            raise TableError(self.path, f'the column {name} ' + (
                f'has the unit {unit}' if unit else 'names no unit')
                + '; write ' + ' or '.join(f'{name} [{u}]' if u else name for u in factors))
        values = factors[unit] * np.array([_number(text) for text in texts])
        for row in np.flatnonzero(~(np.abs(values) <= MAX_VALUE))[:1]:
            raise TableError(self.path, f'row {row + 1}: {name} is "{texts[row]}", expected a '
                             f'number up to {MAX_VALUE:g} in SI units, with a decimal point')
        return values


def require_different(rows: Array) -> None:
    """Raise DataError for rows (n, k) of a table that repeat others."""
    first = np.unique(rows, axis=0, return_index=True)[1]
    repeated = np.setdiff1d(np.arange(len(rows)), first) + 1
    if len(repeated):
        raise DataError(f'{len(repeated)} rows repeat others to the last digit, first row '
                        f'{repeated[0]}: the answer would seem more certain than it is; keep each '
                        'row once')


def _number(text: str) -> float:
    """Return the number of a text, NaN for any other text."""
    try:
        return math.nan if '_' in text else float(text)  # Python's 1_000 is no number of a table
    except ValueError:
        return math.nan


def _axes(prefix: str) -> list[str]:
    """Return the names of the columns x, y and z with a prefix."""
    return [f'{prefix}_{axis}' for axis in 'xyz']
