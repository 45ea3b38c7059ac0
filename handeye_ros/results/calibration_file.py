# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Writes and reads calibration.yaml; a refusal names the file and the key."""
from __future__ import annotations

from dataclasses import asdict, fields, MISSING, replace
from datetime import datetime, UTC
from functools import cache
import hashlib
import math
from pathlib import Path
import sys
from typing import Any, get_args, get_type_hints, TypeVar

from handeye_ros import __version__, se3
from handeye_ros.config import Config, from_provenance, read_yaml
from handeye_ros.data import Array, Calibration, ClockEstimate, Quality, SampleReport
from handeye_ros.errors import InputError, path_of, require_type, unusable_file
from handeye_ros.output import write_atomically, yaml_text
import numpy as np
from scipy.spatial.transform import Rotation

Kind = TypeVar('Kind')

FORMAT = 'handeye_ros/calibration/'
NEWEST = 1  # number of each format that is read again
NAME = 'calibration.yaml'

HEADER = """\
# Hand-eye calibration. T is the pose of {child} in {parent}: it maps points of {child}
# into {parent}, p_{parent} = T @ p_{child}. Metres and radians; quaternion x y z w; rpy is
# that of URDF; the covariance (6x6) is of x y z rx ry rz, in {parent}.
"""

LARGEST_NUMBER = sys.float_info.max  # also of whole numbers
SAME_ROTATION = 1e-5  # rad between rpy and quaternion: written with few digits


def write_calibration(calibration: Calibration, path: Path | str) -> None:
    """
    Write a calibration as YAML; the time is added to the provenance if missing.

    Raises UnwritableError; then nothing is left behind.
    """
    require_type('calibration', calibration, Calibration)
    write_atomically(path_of('path', path), text(dated(calibration)))


def dated(calibration: Calibration) -> Calibration:
    """Return a calibration with the version and the time in its provenance."""
    first = {'version': __version__, 'created': datetime.now(UTC).isoformat(timespec='seconds')}
    return replace(calibration, provenance={**first, **calibration.provenance})


def one_line(text: str) -> str:
    """Return a text without line ends, safe inside a comment."""
    return ' '.join(text.split())


def text(calibration: Calibration) -> str:
    """Return the content of the file."""
    header = HEADER.format(parent=one_line(calibration.parent_frame),
                           child=one_line(calibration.child_frame))
    return header + yaml_text(_content(calibration))


def _content(calibration: Calibration) -> dict[str, Any]:
    T, offset = calibration.T_flange_sensor, calibration.time_offset
    provenance = dict(calibration.provenance)
    config = provenance.pop('config', {})
    return {
        'format': f'{FORMAT}{NEWEST}',
        'name': calibration.name, 'method': calibration.method,
        'parent_frame': calibration.parent_frame, 'child_frame': calibration.child_frame,
        'transform': se3.transform_values(T), 'rpy': se3.rpy(T),
        'covariance': calibration.covariance.ravel(), 'target': calibration.target,
        **({'time_offset': asdict(offset)} if offset else {}),
        'quality': asdict(calibration.quality),
        'samples': [{key: value for key, value in asdict(report).items()
                     if value is not None and value != ''} for report in calibration.samples],
        'provenance': {**provenance, 'config': config},  # long: after all others
    }


def input_values(file: Path) -> dict[str, str]:
    """Return the absolute path and the sha256 of an input file, as in the provenance."""
    with file.open('rb') as stream:
        digest = hashlib.file_digest(stream, 'sha256')
    return {'path': str(file.absolute()), 'sha256': digest.hexdigest()}


def config_of(calibration: Calibration) -> Config:
    """Return the configuration stored in a calibration."""
    return from_provenance(calibration.provenance.get('config'))


def use_config(calibration: Calibration, config: Config | None = None) -> Config:
    """Return the configuration to measure with a calibration: its own or config, at rest."""
    config = config or config_of(calibration)
    if calibration.time_offset:
        config = replace(config, time_offset=calibration.time_offset.value)
    mode = config.sampling.mode if not config.sampling.moving else 'still'
    return replace(config, sampling=replace(config.sampling, mode=mode))


def file_of(path: Path) -> Path:
    """Return the file of a calibration from its path or that of its folder."""
    return path / NAME if path.is_dir() else path


def read_calibration(path: Path | str) -> Calibration:
    """Return the calibration in a file; raises InputError."""
    path = path_of('path', path)
    file = FileSection(path, read_yaml(path))
    require_format(path, file.get('format', str), FORMAT)
    T = transform_from(path, 'transform', file.get('transform', dict))
    _check_rpy(file, T)
    return Calibration(
        **{name: file.get(name, str) for name in ('name', 'method', 'parent_frame',
                                                  'child_frame')},
        T_flange_sensor=T, covariance=file.numbers('covariance', 36).reshape(6, 6),
        target=file.get('target', dict), quality=file.section('quality').read(Quality),
        samples=tuple(FileSection(path, item, f'samples[{i}].').read(SampleReport)
                      for i, item in enumerate(file.get('samples', list))),
        provenance=file.get('provenance', dict),
        time_offset=file.section('time_offset').read(ClockEstimate) if 'time_offset' in file.values
        else None)


def transform_from(path: Path, key: str, values: Any) -> Array:
    """Return the transform (4, 4) of plain values, which a file holds under a key."""
    section = FileSection(path, values, f'{key}.')
    found = {part: {axis: section.section(part).get(axis, float) for axis in axes}
             for part, axes in (('translation', 'xyz'), ('rotation', 'xyzw'))}
    length = math.hypot(*found['rotation'].values())
    if abs(length - 1) > 1e-6:
        raise section.error('rotation', f'is a quaternion of length {length:.6g}, expected 1')
    return se3.from_values(found)


def _check_rpy(file: FileSection, T: Array) -> None:
    """Raise for angles that were edited without the quaternion, which is the one used."""
    if 'rpy' not in file.values:
        return
    R = Rotation.from_euler('xyz', file.numbers('rpy', 3)).inv() * Rotation.from_matrix(T[:3, :3])
    if R.magnitude() > SAME_ROTATION:
        raise file.error('rpy', f'and transform.rotation differ by '
                         f'{math.degrees(R.magnitude()):.4g} degrees. The quaternion counts: '
                         'correct it, and correct rpy or delete it')


def require_format(path: Path, text: str, kind: str) -> None:
    """Raise InputError for another format than the kind and its number NEWEST, or less."""
    number = text.removeprefix(kind)
    if number == text or not number.isdecimal():
        raise unusable_file(path, f'its format is "{text}", expected {kind}{NEWEST}')
    if int(number) > NEWEST:
        raise unusable_file(path, f'its format {text} is newer than this version of handeye_ros '
                            f'({__version__}) can read; update the package')


class FileSection:
    """A mapping in a file; each value is checked on access, and a refusal names file and key."""

    def __init__(self, path: Path, values: Any, prefix: str = '') -> None:
        if not isinstance(values, dict):
            raise unusable_file(path, f'{prefix.rstrip(".") or "the file"} is no mapping')
        self.path, self.values, self._prefix = path, values, prefix

    def get(self, key: str, kind: type) -> Any:
        """Return a value of a type; numbers are finite."""
        value = self.values.get(key)
        if value is None:
            raise self.error(key, 'is missing')
        actual = type(value)
        if actual is not kind and (actual, kind) != (int, float):
            raise self.error(key, f'is {value!r}, expected {kind.__name__}')
        if kind is float and not abs(value) <= LARGEST_NUMBER:
            raise self.error(key, f'is {value}')
        return kind(value)

    def numbers(self, key: str, count: int) -> Array:
        """Return a list of finite numbers as an array (count,)."""
        values: list[Any] = self.get(key, list)
        if len(values) != count or not all(
                type(v) in (int, float) and abs(v) <= LARGEST_NUMBER for v in values):
            raise self.error(key, f'does not hold {count} numbers')
        return np.array(values, dtype=float)

    def section(self, key: str) -> FileSection:
        """Return a nested mapping."""
        return FileSection(self.path, self.get(key, dict), f'{self._prefix}{key}.')

    def read(self, kind: type[Kind]) -> Kind:
        """Return a dataclass from its fields; those with a default may be missing."""
        return kind(**{name: self.get(name, wanted) for name, (wanted, required) in _fields(
            kind).items()  # type: ignore[arg-type]
            if required or self.values.get(name) is not None})

    def error(self, key: str, problem: str) -> InputError:
        """Return the error for a key."""
        return unusable_file(self.path, f'{self._prefix}{key} {problem}')


@cache
def _fields(kind: Any) -> dict[str, tuple[type, bool]]:
    """Return the type of each field of a dataclass (of "float | None": float), if required."""
    types = get_type_hints(kind)
    return {item.name: (next(iter(get_args(types[item.name])), types[item.name]),
                        item.default is MISSING) for item in fields(kind)}
