# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Reads and writes truth.yaml of simulated recordings; errors of an answer against it."""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from handeye_ros import se3
from handeye_ros.config import read_yaml
from handeye_ros.data import Array
from handeye_ros.results.calibration_file import transform_from, value_of
import numpy as np

NAME = 'truth.yaml'
SIDE_POINTS = 13  # points along each side of the field of view: fewer would be mostly its corners
FIELD_TEXT = 'x within +-20 mm, range 160-190 mm'


def true_transform(bag: Path) -> Array | None:
    """
    Return the true T_flange_sensor (4, 4) of a bag, None if it is unknown.

    bag: a rosbag2 folder, or a file in one. Raises InputError for a damaged truth.yaml.
    """
    path = (bag if bag.is_dir() else bag.parent) / NAME
    if not path.is_file():
        return None
    content = value_of(path, 'the file', read_yaml(path), dict)
    return transform_from(path, 'T_flange_sensor', content.get('T_flange_sensor'))


@dataclass(frozen=True)
class Errors:
    """
    The difference between two transforms.

    translation: metres
    rotation: radians
    mapped_points: RMS over the field of view, metres
    """

    translation: float
    rotation: float
    mapped_points: float


def errors_against(T_est: Array, T_true: Array, field: Array | None = None) -> Errors:
    """
    Return the errors of T_flange_sensor (4, 4) against the true one.

    field: points (k, 3) in the sensor frame that are mapped, field_points when not given. The
    RMS of |(T_est - T_true) p| is the error in use; that of the translation alone is dominated by
    the lever arm of the rotation.
    """
    delta, points = se3.difference(T_est, T_true), field_points() if field is None else field
    away = se3.apply(T_est, points) - se3.apply(T_true, points)
    return Errors(float(np.linalg.norm(delta[:3])), float(np.linalg.norm(delta[3:])),
                  float(np.sqrt((away ** 2).sum(axis=1).mean())))


def field_points(x: tuple[float, float] = (-0.02, 0.02), z: tuple[float, float] = (0.16, 0.19)
                 ) -> Array:
    """Return a grid (k, 3) in the sensor plane, along the line within x, in range within z."""
    along, across = np.meshgrid(np.linspace(*x, SIDE_POINTS), np.linspace(*z, SIDE_POINTS))
    return np.column_stack([along.ravel(), np.zeros(along.size), across.ravel()])
