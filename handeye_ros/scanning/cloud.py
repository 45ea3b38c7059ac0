# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Files of clouds, PLY and PCD: written piece by piece, and read (not compressed)."""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import takewhile
import math
from pathlib import Path
import re
from typing import Any, TypeAlias
import warnings

from handeye_ros.data import Array
from handeye_ros.errors import InputError, unusable_file
from handeye_ros.output import atomic_file
import numpy as np
from numpy.typing import NDArray

Points: TypeAlias = NDArray[np.void]

CLOUD_SUFFIXES = ('.ply', '.pcd')
"""The endings of the names of cloud files."""
COUNT_DIGITS = 15  # reserved for the number of points
# types of PLY that numpy calls otherwise
PLY_TYPES = {'char': 'int8', 'uchar': 'uint8', 'int': 'int32', 'uint': 'uint32',
             'float': 'float32'}
MAX_HEADER_LENGTH = 1 << 16


def require_suffix(path: Path) -> None:
    """Raise InputError for a file name of another format."""
    if path.suffix.lower() not in CLOUD_SUFFIXES:
        raise InputError(f'{path}: the file name must end with {" or ".join(CLOUD_SUFFIXES)}')


def write_cloud(path: Path, pieces: Iterable[Points], comment: str = '') -> None:
    """
    Write a cloud piece by piece; the file appears only when all pieces are written.

    Each piece is an array with the fields of its points, all float32, among them x, y and z in
    metres. The comment stands in the header and names the frame. Raises InputError for another
    file name than those of CLOUD_SUFFIXES, and UnwritableError.
    """
    require_suffix(path)
    fields, count = tuple[str, ...](), 0
    with atomic_file(path) as temporary, temporary.open('wb') as stream:
        for points in pieces:
            if not fields:
                fields = points.dtype.names or ()
                stream.write(_header(path.suffix.lower(), fields, 0, comment))
            stream.write(points.tobytes())
            count += len(points)
        stream.seek(0)
        stream.write(_header(path.suffix.lower(), fields, count, comment))


def _header(suffix: str, names: Sequence[str], count: int, comment: str) -> bytes:
    """Return the header of a cloud, of the same length for every number of points."""
    padded_count = f'{count:0{COUNT_DIGITS}}'
    if suffix == '.ply':
        lines = ['ply', 'format binary_little_endian 1.0', f'comment {comment}',
                 f'element vertex {padded_count}', *(f'property float {name}' for name in names),
                 'end_header']
    else:
        lines = ['# .PCD v0.7 - Point Cloud Data file format', f'# {comment}', 'VERSION 0.7',
                 f'FIELDS {" ".join(names)}', f'SIZE{" 4" * len(names)}',
                 f'TYPE{" F" * len(names)}', f'COUNT{" 1" * len(names)}', f'WIDTH {padded_count}',
                 'HEIGHT 1', 'VIEWPOINT 0 0 0 1 0 0 0', f'POINTS {padded_count}', 'DATA binary']
    return '\n'.join([*lines, '']).encode('ascii', 'backslashreplace')  # a frame in any script


def read_cloud(path: Path) -> Array:
    """
    Return the finite points (n, 3) of a PLY or PCD file, in metres and in the frame of the file.

    The file may be ASCII or binary (little-endian). Raises InputError for other files.
    """
    layout = _ply_layout if path.suffix.lower() == '.ply' else _pcd_layout
    try:
        # loadtxt warns of a file without points, which is told below or by who needs them
        with path.open('rb') as stream, warnings.catch_warnings(action='ignore'):
            length, lines = _header_lines(stream.read(MAX_HEADER_LENGTH))
            form, dtype, count = layout(lines)
            stream.seek(length)
            if form == 'ascii':
                names = [name for name in dtype.names or ()
                         for _ in range(math.prod(dtype[name].shape))]  # of each column
                columns = [names.index(axis) for axis in 'xyz']
                points = np.loadtxt(stream, usecols=columns, max_rows=count, ndmin=2)
            else:
                rows = np.fromfile(stream, dtype)[:count]
                points = np.column_stack([rows[axis] for axis in 'xyz']).astype(float)
    except OSError as error:
        raise unusable_file(path, error.strerror or str(error)) from error
    except (IndexError, KeyError, TypeError, ValueError) as error:
        raise InputError(f'{path}: is damaged, or no cloud with x, y and z in ASCII or binary '
                         '(little-endian, not compressed) form') from error
    if len(points) < count:
        raise InputError(f'{path}: is cut off: {len(points)} of {count} points')
    return points[np.isfinite(points).all(axis=1)]


def frame_of(path: Path) -> str:
    """Return the frame that the comment of a cloud of `handeye scan` names, '' without one."""
    with path.open('rb') as stream:
        named = re.search(rb'frame (.+), metres', stream.read(MAX_HEADER_LENGTH))
    return named[1].decode('unicode_escape') if named else ''


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
    form, = (words[1] for words in lines if words[0] == 'format')
    first = [words[0] for words in lines].index('element')
    if lines[0] != ['ply'] or lines[first][1] != 'vertex' or form == 'binary_big_endian':
        raise ValueError
    properties = takewhile(lambda words: words[0] == 'property', lines[first + 1:])
    fields = [(name, np.dtype(PLY_TYPES.get(kind, kind)).newbyteorder('<'))
              for _, kind, name in properties]
    return form.split('_')[0], np.dtype(fields), int(lines[first][2])


def _pcd_layout(lines: list[list[str]]) -> tuple[str, np.dtype[Any], int]:
    """Return form (ascii or binary), fields and number of the points of a PCD header."""
    values = {words[0]: words[1:] for words in lines}
    names = values['FIELDS']
    counts = values.get('COUNT', ['1'] * len(names))
    # PCL pads with fields that are all called "_"
    fields = [(f'_{k}' if name == '_' else name, f'<{kind.lower()}{size}', (int(count),))
              for k, (name, kind, size, count) in enumerate(zip(
                  names, values['TYPE'], values['SIZE'], counts, strict=True))]
    if values['DATA'][0] not in ('ascii', 'binary'):
        raise ValueError
    return values['DATA'][0], np.dtype(fields), int(values['POINTS'][0])
