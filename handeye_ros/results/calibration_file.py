# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Writes and reads calibration.yaml."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from datetime import datetime, UTC
import hashlib
import math
from pathlib import Path
from typing import Any

from handeye_ros import __version__, se3
from handeye_ros.data import Array, Calibration, Quality, SampleReport, TimeOffset
from handeye_ros.output import write_whole
from handeye_ros.results.reading import content_of, require_format, Section
import numpy as np
from scipy.spatial.transform import Rotation
import yaml

FORMAT = 'handeye_ros/calibration/'
NAME = 'calibration.yaml'

HEADER = """\
# Hand-eye calibration. T is the pose of {child} in {parent}: it maps points of {child}
# into {parent}, p_{parent} = T @ p_{child}. Metres and radians; quaternion x y z w; rpy is
# that of URDF; the covariance (6x6) is of x y z rx ry rz, in {parent}.
"""

SAME_ROTATION = 1e-5  # rad between rpy and quaternion: written with few digits


def write_calibration(calibration: Calibration, path: Path) -> None:
    """
    Write a calibration as YAML; the time is added to the provenance if missing.

    Raises UnwritableError; then nothing is left behind.

    """
    write_whole(path, text(dated(calibration)))


def dated(calibration: Calibration) -> Calibration:
    """Return a calibration with the version and the time in its provenance."""
    first = {'version': __version__, 'created': datetime.now(UTC).isoformat(timespec='seconds')}
    return replace(calibration, provenance={**first, **calibration.provenance})


def text(calibration: Calibration) -> str:
    """Return the content of the file."""
    header = HEADER.format(parent=calibration.parent_frame, child=calibration.child_frame)
    return header + str(yaml.safe_dump(_content(calibration), sort_keys=False, width=100,
                                       default_flow_style=None, allow_unicode=True))


def _content(calibration: Calibration) -> dict[str, Any]:
    T, offset = calibration.T_flange_sensor, calibration.time_offset
    provenance = _plain(calibration.provenance)
    return {
        'format': f'{FORMAT}1',
        'name': calibration.name, 'method': calibration.method,
        'parent_frame': calibration.parent_frame, 'child_frame': calibration.child_frame,
        'transform': transform_values(T), 'rpy': _plain(se3.rpy(T)),
        'covariance': _plain(calibration.covariance.ravel()),
        'target': _plain(calibration.target),
        **({'time_offset': _plain(asdict(offset))} if offset else {}),
        'quality': _plain(asdict(calibration.quality)),
        'samples': [{key: _plain(value) for key, value in asdict(report).items()
                     if value is not None and value != ''} for report in calibration.samples],
        'provenance': {**{k: v for k, v in provenance.items() if k != 'config'},
                       'config': provenance.get('config', {})},  # long: after all others
    }


def transform_values(T: Array) -> dict[str, dict[str, float]]:
    """Return a transform (4, 4) as plain values: translation x y z, rotation x y z w."""
    return {'translation': dict(zip('xyz', map(float, T[:3, 3]), strict=True)),
            'rotation': dict(zip('xyzw', map(float, se3.quaternion(T)), strict=True))}


def input_values(file: Path) -> dict[str, str]:
    """Return the absolute path and the sha256 of an input file, as in the provenance."""
    with file.open('rb') as stream:
        digest = hashlib.file_digest(stream, 'sha256')
    return {'path': str(file.absolute()), 'sha256': digest.hexdigest()}


def _plain(value: Any) -> Any:
    """Return a value with types of YAML."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value


def file_of(path: Path) -> Path:
    """Return the file of a calibration from its path or that of its folder."""
    return path / NAME if path.is_dir() else path


def read_calibration(path: Path) -> Calibration:
    """Return the calibration in a file; raises InputError."""
    file = Section(path, '', content_of(path))
    require_format(path, file.get('format', str), FORMAT)
    T = _transform(file.section('transform'))
    _check_rpy(file, T)
    offset = file.section('time_offset') if file.has('time_offset') else None
    quality = file.section('quality')
    return Calibration(
        name=file.get('name', str),
        method=file.get('method', str),
        parent_frame=file.get('parent_frame', str),
        child_frame=file.get('child_frame', str),
        T_flange_sensor=T,
        covariance=_covariance(file),
        target=file.get('target', dict),
        quality=Quality(
            quality.get('samples_used', int), quality.get('samples_rejected', int),
            quality.number('residual_rms'), quality.number('holdout_rms'),
            quality.get('weakest_direction', str), quality.number('weakest_std')),
        samples=tuple(_sample(Section(path, f'samples[{i}].', item))
                      for i, item in enumerate(file.get('samples', list))),
        provenance=file.get('provenance', dict),
        time_offset=TimeOffset(offset.number('value'), offset.number('std')) if offset else None)


def transform_from(path: Path, key: str, values: Any) -> Array:
    """Return the transform (4, 4) of plain values, which a file holds under a key."""
    return _transform(Section(path, f'{key}.', values))


def _transform(section: Section) -> Array:
    translation, rotation = section.section('translation'), section.section('rotation')
    quaternion = np.array([rotation.number(key) for key in 'xyzw'])
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1) > 1e-6:
        raise section.error('rotation', f'is a quaternion of length {length:.6g}, expected 1')
    return se3.from_quaternion(np.array([translation.number(key) for key in 'xyz']), quaternion)


def _check_rpy(file: Section, T: Array) -> None:
    """Raise for angles that were edited without the quaternion, which is the one used."""
    if not file.has('rpy'):
        return
    rpy = file.get('rpy', list)
    if len(rpy) != 3 or not all(type(v) in (int, float) and math.isfinite(v) for v in rpy):
        raise file.error('rpy', 'does not hold 3 numbers')
    R = Rotation.from_euler('xyz', rpy).inv() * Rotation.from_matrix(T[:3, :3])
    if R.magnitude() > SAME_ROTATION:
        raise file.error('rpy', f'and transform.rotation differ by '
                         f'{math.degrees(R.magnitude()):.4g} degrees. The quaternion counts: '
                         'correct it, and correct rpy or delete it')


def _covariance(file: Section) -> Array:
    values = file.get('covariance', list)
    numbers = [v for v in values if type(v) in (int, float) and math.isfinite(v)]
    if len(values) != 36 or len(numbers) != 36:
        raise file.error('covariance', 'does not hold 36 numbers')
    return np.array(numbers, dtype=float).reshape(6, 6)


def _sample(section: Section) -> SampleReport:
    residual = section.number('residual') if section.has('residual') else None
    return SampleReport(section.get('stamp', int), section.get('used', bool),
                        section.get('edge', str, ''), residual, section.get('reason', str, ''))
