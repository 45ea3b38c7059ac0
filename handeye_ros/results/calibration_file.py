# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Writes and reads calibration.yaml."""
from __future__ import annotations

from dataclasses import asdict, replace
import math
from pathlib import Path
import re
from typing import Any

from handeye_ros import __version__, se3
from handeye_ros.config import Config, from_provenance, read_yaml, SamplesConfig
from handeye_ros.data import Array, Calibration, ClockEstimate, Quality, SampleReport
from handeye_ros.errors import path_of, require_type, unusable_file
from handeye_ros.output import now_text, write_atomically, yaml_text
from handeye_ros.results.file_values import (
    checked_numbers,
    checked_value,
    Kind,
    require_format,
    transform_from,
)
import numpy as np
from scipy.spatial.transform import Rotation

FORMAT = 'handeye_ros/calibration/1'
NAME = 'calibration.yaml'
SI_TEXT = ('Metres and radians; quaternions are x y z w; roll pitch yaw turn about the fixed axes '
           'x, y, z, as in URDF; covariances (6x6) are of x y z rx ry rz, in the parent frame.')

# the keys below target of one number each
FLOATS = 'radius|distance|scale|rotation_lag|clock_drift|line_bend|setback.*|.*(angle|_error|_std)'
SAME_ROTATION = 1e-5  # rad between rpy and quaternion: written with few digits


def write_calibration(calibration: Calibration, path: Path | str) -> None:
    """
    Write a calibration as YAML; the time is added to the provenance if missing.

    Raises UnwritableError; then nothing is left behind.
    """
    require_type('calibration', calibration, Calibration)
    write_atomically(path_of('path', path), text(with_origin(calibration)))


def with_origin(calibration: Calibration) -> Calibration:
    """Return a calibration whose provenance has a version and a time, by default those of now."""
    origin = {'version': __version__, 'created': now_text()}
    return replace(calibration, provenance={**origin, **calibration.provenance})


def one_line(text: str) -> str:
    """Return a text in one line, as in a comment."""
    return ' '.join(text.split())


def text(calibration: Calibration) -> str:
    """Return the content of calibration.yaml: comments that explain it, and the values."""
    header = ''.join(f'# {line}\n' for line in preamble(calibration))
    return header + yaml_text(content_of(calibration))


def preamble(calibration: Calibration, units: str = SI_TEXT) -> tuple[str, ...]:
    """Return lines on the direction of the transform, its frames, units and uncertainty."""
    parent, child = one_line(calibration.parent_frame), one_line(calibration.child_frame)
    std = np.sqrt(np.diag(calibration.covariance))
    (x, y, z), (rx, ry, rz) = 1e3 * std[:3], np.degrees(std[3:])
    return (
        f'Hand-eye calibration {one_line(calibration.name)} ({one_line(calibration.method)}), '
        f'written by handeye_ros {__version__}.',
        f'The pose of {child} in {parent}: p_{parent} = T @ p_{child}, so it maps points of '
        f'{child} into {parent}.',
        f'Parent frame {parent}, child frame {child}. {units}',
        f'1 sigma of the position: x {x:.3f}, y {y:.3f}, z {z:.3f} mm; of the rotation about the '
        f'axes of {parent}: x {rx:.4f}, y {ry:.4f}, z {rz:.4f} degrees.')


def content_of(calibration: Calibration) -> dict[str, Any]:
    """Return the values that calibration.yaml holds, by key; arrays as such."""
    T, offset = calibration.T_flange_sensor, calibration.time_offset
    provenance = dict(calibration.provenance)
    config = provenance.pop('config', {})
    return {
        'format': FORMAT,
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


def config_of(calibration: Calibration) -> Config:
    """Return the configuration stored in a calibration."""
    return from_provenance(calibration.provenance.get('config'))


def config_to_measure(calibration: Calibration, config: Config | None = None) -> Config:
    """
    Return the configuration to measure with a calibration, with its time offset.

    That is config or, without one, that of the calibration without the numbers of its excluded
    samples. Samples are taken at stops.
    """
    config = config or replace(config_of(calibration), samples=SamplesConfig())
    if calibration.time_offset:
        config = replace(config, time_offset=calibration.time_offset.value)
    return replace(config, sampling=replace(config.sampling, mode='still'))


def file_of(path: Path) -> Path:
    """Return the path of calibration.yaml, given that path or its folder."""
    return path / NAME if path.is_dir() else path


def read_calibration(path: Path | str) -> Calibration:
    """Return the calibration in a file, or in the folder that holds it; raises InputError."""
    path = file_of(path_of('path', path))
    content = checked_value(path, 'its content', read_yaml(path), dict)

    def get(key: str, kind: type[Kind]) -> Kind:
        return checked_value(path, key, content.get(key), kind)

    require_format(path, get('format', str), FORMAT)
    T = transform_from(path, 'transform', content.get('transform'))
    if 'rpy' in content:
        _require_same_rotation(path, checked_numbers(path, 'rpy', content['rpy'], 3), T)
    name, method, parent, child = (get(key, str) for key in (
        'name', 'method', 'parent_frame', 'child_frame'))
    covariance = checked_numbers(path, 'covariance', content.get('covariance'), 36).reshape(6, 6)
    if covariance.diagonal().min() < 0:
        raise unusable_file(path, 'covariance has a negative variance')
    target = get('target', dict)
    _require_estimates(path, target)
    return Calibration(
        name, method, parent, child, T, covariance, target, get('quality', Quality),
        tuple(checked_value(path, f'samples[{i}]', item, SampleReport)
              for i, item in enumerate(get('samples', list))), get('provenance', dict),
        get('time_offset', ClockEstimate) if 'time_offset' in content else None)


def _require_estimates(path: Path, target: dict[str, Any]) -> None:
    """Raise InputError for an estimate of target that is damaged; of unknown keys any is good."""
    for key, value in target.items():
        name = f'target.{key}'
        if key == 'pose':
            transform_from(path, name, value)
        elif key == 'joint':
            for part, values in checked_value(path, name, value, dict).items():
                checked_numbers(path, f'{name}.{part}',
                                values if isinstance(values, list) else [values])
        elif re.fullmatch('centre|point|direction|normal.*', str(key)):
            checked_numbers(path, name, [*value.values()] if isinstance(value, dict) else value, 3)
        elif re.fullmatch(FLOATS, str(key)):
            checked_value(path, name, value, float)


def _require_same_rotation(path: Path, rpy: Array, T: Array) -> None:
    """Raise InputError for angles (3,) that were edited without the quaternion, which counts."""
    R = Rotation.from_euler('xyz', rpy).inv() * Rotation.from_matrix(T[:3, :3])
    if R.magnitude() > SAME_ROTATION:
        raise unusable_file(path, 'rpy and transform.rotation differ by '
                            f'{math.degrees(R.magnitude()):.4g} degrees. The quaternion counts: '
                            'correct it, and correct rpy or delete it')
