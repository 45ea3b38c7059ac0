# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Checks the values in a file, where a refusal names file and key; path and hash of an input."""
from __future__ import annotations

from dataclasses import fields, is_dataclass, MISSING
from functools import cache
import hashlib
import math
from pathlib import Path
import sys
from typing import Any, cast, get_args, get_type_hints, TypeVar

from handeye_ros import __version__, se3
from handeye_ros.data import Array
from handeye_ros.errors import unusable_file
import numpy as np

Kind = TypeVar('Kind')


def require_format(path: Path, text: str, newest: str) -> None:
    """
    Raise InputError for a file of another format, or of a newer number.

    text: the format in the file; newest: the one expected, with the largest number that is
    understood.
    """
    name, _, number = text.rpartition('/')
    expected, _, largest = newest.rpartition('/')
    if name != expected or not number.isdecimal():
        raise unusable_file(path, f'its format is "{text}", expected {newest}')
    if int(number) > int(largest):
        raise unusable_file(path, f'its format {text} is newer than this version of handeye_ros '
                            f'({__version__}) can read; update the package')


def checked_value(path: Path, key: str, value: Any, kind: type[Kind]) -> Kind:
    """
    Return the value that a file has under a dotted key; raises InputError, which names both.

    kind: a plain type, where numbers must be finite, or a dataclass of such, given as a mapping;
    only its fields with a default may be missing.
    """
    if is_dataclass(kind):
        values, types = checked_value(path, key, value, dict), _types_of(kind)
        names = [item.name for item in fields(kind)
                 if item.default is MISSING or values.get(item.name) is not None]
        return cast(Kind, kind(**{
            name: checked_value(path, f'{key}.{name}', values.get(name), types[name])
            for name in names}))
    right = type(value) is kind or (type(value), kind) == (int, float)
    if not right or kind is float and not abs(value) <= sys.float_info.max:
        found = 'missing' if value is None else repr(value)[:40]
        expected = {float: 'a finite number', dict: 'a mapping'}.get(kind, kind.__name__)
        raise unusable_file(path, f'{key} is {found}, expected {expected}')
    return kind(value)  # type: ignore[call-arg]


@cache
def _types_of(kind: Any) -> dict[str, Any]:
    """Return the type of each field of a dataclass by name; of "float | None" float."""
    return {name: (*get_args(hint), hint)[0] for name, hint in get_type_hints(kind).items()}


def checked_numbers(path: Path, key: str, value: Any, count: int | None = None) -> Array:
    """Return the finite numbers (count,) that a file lists under a key; raises InputError."""
    values = checked_value(path, key, value, list)
    if count is not None and len(values) != count:
        raise unusable_file(path, f'{key} does not hold {count} numbers')
    return np.array([checked_value(path, f'{key}[{i}]', v, float) for i, v in enumerate(values)])


def transform_from(path: Path, key: str, value: Any) -> Array:
    """Return the transform (4, 4) of the values under a key of a file; raises InputError."""
    given, checked = checked_value(path, key, value, dict), dict[str, dict[str, float]]()
    for part, axes in (('translation', 'xyz'), ('rotation', 'xyzw')):
        values = checked_value(path, f'{key}.{part}', given.get(part), dict)
        checked[part] = {axis: checked_value(path, f'{key}.{part}.{axis}', values.get(axis), float)
                         for axis in axes}
    length = math.hypot(*checked['rotation'].values())
    if abs(length - 1) > 1e-6:
        raise unusable_file(path, f'{key}.rotation is a quaternion of length {length:.6g}, '
                            'expected 1')
    return se3.transform_from_values(checked)


def input_provenance(file: Path) -> dict[str, str]:
    """Return the absolute path and the sha256 of an input file, as in the provenance."""
    with file.open('rb') as stream:
        digest = hashlib.file_digest(stream, 'sha256')
    return {'path': str(file.absolute()), 'sha256': digest.hexdigest()}
