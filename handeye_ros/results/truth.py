# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The truth of a simulated recording (truth.yaml), and the errors of an answer against it."""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from handeye_ros import se3
from handeye_ros.arithmetic import rms
from handeye_ros.config import read_yaml
from handeye_ros.data import Array
from handeye_ros.results.file_values import checked_value, transform_from
import numpy as np

TRUTH_NAME = 'truth.yaml'
SIDE_POINTS = 13  # points along each side of the field of view: fewer would be mostly its corners
FIELD_X, FIELD_RANGE = (-0.02, 0.02), (0.16, 0.19)  # of a typical field of view (m)
FIELD_TEXT = (f'x within +-{FIELD_X[1] * 1e3:.0f} mm, '
              f'range {FIELD_RANGE[0] * 1e3:.0f}-{FIELD_RANGE[1] * 1e3:.0f} mm')


def true_transform(bag: Path, corrected: bool = False) -> Array | None:
    """
    Return the true T_flange_sensor (4, 4) of a bag, None if it is unknown.

    bag: a rosbag2 folder, or a file in one; corrected: whether the flange is that of the corrected
    arm. Raises InputError for a damaged truth.yaml.
    """
    path = (bag if bag.is_dir() else bag.parent) / TRUTH_NAME
    if not path.is_file():
        return None
    content = checked_value(path, 'its content', read_yaml(path), dict)
    key = 'T_corrected_sensor' if corrected else 'T_flange_sensor'
    if corrected and key not in content:
        return None
    return transform_from(path, key, content.get(key))


@dataclass(frozen=True)
class TransformErrors:
    """
    The difference between two transforms.

    translation: metres
    rotation: radians
    mapped_points: RMS over the field of view, metres
    """

    translation: float
    rotation: float
    mapped_points: float


def errors_against(T_est: Array, T_true: Array, field: Array | None = None) -> TransformErrors:
    """
    Return the errors of a transform (4, 4) from the sensor plane against the true one.

    field: points (k, 3) in that plane that are mapped (m), field_points when not given. The RMS
    of |(T_est - T_true) p| is the error in use; that of the translation alone is dominated by the
    lever arm of the rotation.
    """
    delta, points = se3.difference(T_est, T_true), field_points() if field is None else field
    distances = np.linalg.norm(se3.apply(T_est, points) - se3.apply(T_true, points), axis=1)
    return TransformErrors(float(np.linalg.norm(delta[:3])), float(np.linalg.norm(delta[3:])),
                           rms(distances))


def field_points(x: tuple[float, float] = FIELD_X, z: tuple[float, float] = FIELD_RANGE) -> Array:
    """Return a grid of points (k, 3) in the sensor plane (m): x along the line, z the range."""
    on_line, ranges = np.meshgrid(np.linspace(*x, SIDE_POINTS), np.linspace(*z, SIDE_POINTS))
    return np.column_stack([on_line.ravel(), np.zeros(on_line.size), ranges.ravel()])
