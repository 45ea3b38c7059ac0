# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Point clouds as PLY and PCD files, written in pieces with constant memory.

The header states the number of points, which is known only at the end: the header reserves space
for it. The common libraries for these formats hold a whole cloud in memory; the tests read the
written files with them.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

from handeye_ros.data import Array
from handeye_ros.errors import InputError
from handeye_ros.output import replaced
import numpy as np
from numpy.typing import NDArray

Points: TypeAlias = NDArray[np.void]
Header: TypeAlias = Callable[[int, 'np.dtype[Any]', str], str]

DIGITS = 15  # reserved for the number of points
PLY_TYPES = {'f4': 'float', 'f8': 'double', 'i1': 'char', 'u1': 'uchar', 'i2': 'short',
             'u2': 'ushort', 'i4': 'int', 'u4': 'uint'}
PLY_ALIASES = {'float32': 'f4', 'float64': 'f8', 'int8': 'i1', 'uint8': 'u1', 'int16': 'i2',
               'uint16': 'u2', 'int32': 'i4', 'uint32': 'u4'}
LONGEST_HEADER = 1 << 16


def _kinds(dtype: np.dtype[Any]) -> list[tuple[str, str]]:
    """Return name and type code (f4, u2, ...) of each field."""
    return [(name, dtype[name].str[1:]) for name in dtype.names or ()]


def ply_header(count: int, dtype: np.dtype[Any], comment: str) -> str:
    """Return the header of a PLY file for a number of points, always of the same length."""
    number = str(count)
    return '\n'.join([
        'ply', 'format binary_little_endian 1.0', f'comment {comment}',
        f'comment {"." * (DIGITS - len(number))}', f'element vertex {number}',
        *(f'property {PLY_TYPES[kind]} {name}' for name, kind in _kinds(dtype)),
        'end_header', ''])


def pcd_header(count: int, dtype: np.dtype[Any], comment: str) -> str:
    """Return the header of a PCD file for a number of points, always of the same length."""
    names, kinds = zip(*_kinds(dtype), strict=True)
    room = '.' * 2 * (DIGITS - len(str(count)))
    return '\n'.join([
        '# .PCD v0.7 - Point Cloud Data file format', f'# {comment} {room}', 'VERSION 0.7',
        f'FIELDS {" ".join(names)}', f'SIZE {" ".join(kind[1] for kind in kinds)}',
        f'TYPE {" ".join(kind[0].upper() for kind in kinds)}',
        f'COUNT {" ".join("1" for _ in kinds)}', f'WIDTH {count}', 'HEIGHT 1',
        'VIEWPOINT 0 0 0 1 0 0 0', f'POINTS {count}', 'DATA binary', ''])


FORMATS: dict[str, Header] = {'.ply': ply_header, '.pcd': pcd_header}
"""The writable formats of a cloud by file extension."""


class CloudWriter:
    """Writes pieces of a cloud, all of the type of the first."""

    def __init__(self, stream: BinaryIO, header: Header, comment: str) -> None:
        """Start with no points."""
        self.count = 0
        self._stream, self._header, self._comment = stream, header, comment
        self._dtype: np.dtype[Any] | None = None

    def write(self, points: Points) -> None:
        """Append points, a structured array of little-endian fields."""
        if self._dtype is None:
            self._dtype = points.dtype
            self._put_header()
        self._stream.write(points.tobytes())
        self.count += len(points)

    def finish(self) -> None:
        """Write the number of points into the header."""
        if self._dtype is not None:
            self._stream.seek(0)
            self._put_header()

    def _put_header(self) -> None:
        assert self._dtype is not None
        self._stream.write(self._header(self.count, self._dtype, self._comment).encode('ascii'))


def header_of(path: Path) -> Header:
    """Return the function that makes the header of a file; raises InputError."""
    header = FORMATS.get(path.suffix.lower())
    if header is None:
        raise InputError(f'{path}: the file name must end with {" or ".join(FORMATS)}')
    return header


@contextmanager
def cloud_writer(path: Path, comment: str = '') -> Iterator[CloudWriter]:
    """
    Give a writer of a cloud file that appears only when the block ends without an error.

    Raises InputError, UnwritableError.
    """
    header = header_of(path)
    with replaced(path) as temporary, temporary.open('wb') as stream:
        writer = CloudWriter(stream, header, comment)
        yield writer
        writer.finish()


def read_cloud(path: Path) -> Array:
    """
    Return the points (n, 3) of a PLY or PCD file, ASCII or binary little-endian.

    Raises InputError.
    """
    header_of(path)
    try:
        with path.open('rb') as stream:
            header_size, lines = _header_lines(path, stream.read(LONGEST_HEADER))
    except OSError as error:
        raise InputError(f'{path}: cannot be read: {error.strerror or error}') from error
    parse = _ply_layout if path.suffix.lower() == '.ply' else _pcd_layout
    try:
        binary, dtype, count = parse(lines)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise InputError(f'{path}: its header is not that of a cloud in ASCII or binary '
                         '(little-endian, not compressed) form') from error
    if not {'x', 'y', 'z'} <= set(dtype.names or ()):
        raise InputError(f'{path}: its points have no fields x, y and z')
    points = _body(path, header_size, dtype, count, binary)
    return points[np.isfinite(points).all(axis=1)]


def _header_lines(path: Path, start: bytes) -> tuple[int, list[list[str]]]:
    """Return the length of the header and the words of its lines."""
    lines, position = [], 0
    while (end := start.find(b'\n', position)) >= 0:
        words = start[position:end].decode('latin-1').split()
        position = end + 1
        if words and not words[0].startswith('#') and words[0] != 'comment':
            lines.append(words)
        if words[:1] in (['end_header'], ['DATA']):
            return position, lines
    raise InputError(f'{path}: has no header of a cloud')


def _ply_layout(lines: list[list[str]]) -> tuple[bool, np.dtype[Any], int]:
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
    return form != 'ascii', np.dtype(fields), int(lines[first][2])


def _pcd_layout(lines: list[list[str]]) -> tuple[bool, np.dtype[Any], int]:
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
    return values['DATA'][0] == 'binary', np.dtype(fields), int(values['POINTS'][0])


def _body(path: Path, header_size: int, dtype: np.dtype[Any], count: int, binary: bool) -> Array:
    """Return x, y and z (n, 3) from the data after the header."""
    if binary:
        available = (path.stat().st_size - header_size) // dtype.itemsize
        if available < count:
            raise InputError(f'{path}: is cut off: {available} of {count} points')
        rows = np.memmap(path, dtype, 'r', header_size, (count,)) if count else np.empty(0, dtype)
        return np.column_stack([rows[axis] for axis in 'xyz']).astype(np.float64)
    names = list(dtype.names or ())
    with path.open('rb') as stream:
        stream.seek(header_size)
        try:
            return np.loadtxt(stream, usecols=[names.index(a) for a in 'xyz'], max_rows=count,
                              ndmin=2).reshape(-1, 3)
        except ValueError as error:
            raise InputError(f'{path}: is damaged: {error}') from error
