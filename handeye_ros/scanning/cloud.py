# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Files of clouds, PLY and PCD: written piece by piece, and read (not compressed)."""
from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

from handeye_ros.data import Array
from handeye_ros.errors import InputError
from handeye_ros.output import replaced
import numpy as np
from numpy.typing import NDArray

Points: TypeAlias = NDArray[np.void]

FORMATS = ('.ply', '.pcd')
"""The endings of the files."""
DIGITS = 15  # reserved for the number of points
PLY_TYPES = {'f4': 'float', 'f8': 'double', 'i1': 'char', 'u1': 'uchar', 'i2': 'short',
             'u2': 'ushort', 'i4': 'int', 'u4': 'uint'}
PLY_ALIASES = {'float32': 'f4', 'float64': 'f8', 'int8': 'i1', 'uint8': 'u1', 'int16': 'i2',
               'uint16': 'u2', 'int32': 'i4', 'uint32': 'u4'}
LONGEST_HEADER = 1 << 16


def require_format(path: Path) -> None:
    """Raise InputError for a file name of another format."""
    if path.suffix.lower() not in FORMATS:
        raise InputError(f'{path}: the file name must end with {" or ".join(FORMATS)}')


def _header(suffix: str, count: int, dtype: np.dtype[Any], comment: str) -> bytes:
    """Return the header for a number of points, of the same length for every number."""
    fields = [(name, dtype[name].str[1:]) for name in dtype.names or ()]
    if suffix == '.ply':
        lines = ['ply', 'format binary_little_endian 1.0', f'comment {comment}',
                 f'comment {"." * (DIGITS - len(str(count)))}', f'element vertex {count}',
                 *(f'property {PLY_TYPES[kind]} {name}' for name, kind in fields), 'end_header']
    else:
        lines = ['# .PCD v0.7 - Point Cloud Data file format',
                 f'# {comment} {"." * 2 * (DIGITS - len(str(count)))}', 'VERSION 0.7',
                 f'FIELDS {" ".join(name for name, _ in fields)}',
                 f'SIZE {" ".join(kind[1] for _, kind in fields)}',
                 f'TYPE {" ".join(kind[0].upper() for _, kind in fields)}',
                 f'COUNT {" ".join("1" for _ in fields)}', f'WIDTH {count}', 'HEIGHT 1',
                 'VIEWPOINT 0 0 0 1 0 0 0', f'POINTS {count}', 'DATA binary']
    return ('\n'.join(lines) + '\n').encode('ascii')


class CloudWriter:
    """Writes pieces of a cloud, all of the type of the first; count: the points so far."""

    def __init__(self, stream: BinaryIO, suffix: str, comment: str) -> None:
        """Start with no points."""
        self.count = 0
        self._stream, self._suffix, self._comment = stream, suffix, comment
        self._dtype: np.dtype[Any] | None = None

    def write(self, points: Points) -> None:
        """Append points, a structured array of little-endian fields."""
        if self._dtype is None:
            self._dtype = points.dtype
            self.write_header()
        self._stream.write(points.tobytes())
        self.count += len(points)

    def write_header(self) -> None:
        """Write the header with the number of points so far, if any were written."""
        if self._dtype is not None:
            self._stream.seek(0)
            self._stream.write(_header(self._suffix, self.count, self._dtype, self._comment))


@contextmanager
def cloud_writer(path: Path, comment: str = '') -> Iterator[CloudWriter]:
    """
    Give a writer of a cloud file that appears only when the block ends without an error.

    Raises InputError, UnwritableError.
    """
    require_format(path)
    with replaced(path) as temporary, temporary.open('wb') as stream:
        writer = CloudWriter(stream, path.suffix.lower(), comment)
        yield writer
        writer.write_header()


def read_cloud(path: Path) -> Array:
    """
    Return the finite points (n, 3) of a PLY or PCD file, ASCII or binary little-endian.

    Raises InputError.
    """
    require_format(path)
    try:
        with path.open('rb') as stream:
            start, lines = _header_lines(stream.read(LONGEST_HEADER))
    except OSError as error:
        raise InputError(f'{path}: cannot be read: {error.strerror or error}') from error
    layout = _ply_layout if path.suffix.lower() == '.ply' else _pcd_layout
    try:
        form, dtype, count = layout(lines)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise InputError(f'{path}: its header is not that of a cloud in ASCII or binary '
                         '(little-endian, not compressed) form') from error
    names = list(dtype.names or ())
    if not {'x', 'y', 'z'} <= set(names):
        raise InputError(f'{path}: its points have no fields x, y and z')
    if form == 'ascii':
        with path.open('rb') as stream:
            stream.seek(start)
            try:
                points = np.loadtxt(stream, usecols=[names.index(a) for a in 'xyz'],
                                    max_rows=count, ndmin=2).reshape(-1, 3)
            except ValueError as error:
                raise InputError(f'{path}: is damaged: {error}') from error
    else:
        available = (path.stat().st_size - start) // dtype.itemsize
        if available < count:
            raise InputError(f'{path}: is cut off: {available} of {count} points')
        rows = np.memmap(path, dtype, 'r', start, (count,)) if count else np.empty(0, dtype)
        points = np.column_stack([rows[axis] for axis in 'xyz']).astype(np.float64)
    return points[np.isfinite(points).all(axis=1)]


def _header_lines(start: bytes) -> tuple[int, list[list[str]]]:
    """Return the length of the header, and the words of its lines without comments."""
    lines, position = [], 0
    while (end := start.find(b'\n', position)) >= 0:
        words = start[position:end].decode('latin-1').split()
        position = end + 1
        if words and not words[0].startswith('#') and words[0] != 'comment':
            lines.append(words)
        if words[:1] in (['end_header'], ['DATA']):
            break
    return position, lines


def _ply_layout(lines: list[list[str]]) -> tuple[str, np.dtype[Any], int]:
    """Return form (ascii or binary), fields and number of the points of a PLY header."""
    form = [words[1] for words in lines if words[0] == 'format'][0]
    first = [words[0] for words in lines].index('element')
    if lines[0] != ['ply'] or lines[first][1] != 'vertex' or form == 'binary_big_endian':
        raise ValueError
    codes = {name: code for code, name in PLY_TYPES.items()} | PLY_ALIASES
    fields = []
    for words in lines[first + 1:]:
        if words[0] != 'property':
            break
        fields.append((words[2], f'<{codes[words[1]]}'))
    return form.split('_')[0], np.dtype(fields), int(lines[first][2])


def _pcd_layout(lines: list[list[str]]) -> tuple[str, np.dtype[Any], int]:
    """Return form (ascii or binary), fields and number of the points of a PCD header."""
    values = {words[0]: words[1:] for words in lines}
    fields: list[Any] = []
    for name, kind, size, count in zip(values['FIELDS'], values['TYPE'], values['SIZE'],
                                       values.get('COUNT', ['1'] * len(values['FIELDS'])),
                                       strict=True):
        # PCL pads with fields that are all called "_"
        unique = name if name not in [field[0] for field in fields] else f'{name}{len(fields)}'
        fields.append((unique, f'<{kind.lower()}{size}', *([(int(count),)] * (count != '1'))))
    if values['DATA'][0] not in ('ascii', 'binary'):
        raise ValueError
    return values['DATA'][0], np.dtype(fields), int(values['POINTS'][0])
