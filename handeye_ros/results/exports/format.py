"""
What a format of a saved calibration is, and its preamble.

For programs that know no ROS also a 4x4 matrix, and JSON.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import json
import math

from handeye_ros import __version__, se3
from handeye_ros.data import Array, Calibration
from handeye_ros.results.calibration_file import transform_values
import numpy as np

SI = ('Metres and radians; quaternions are x y z w; roll pitch yaw turn about the fixed axes x, '
      'y, z, as in URDF.')


@dataclass(frozen=True)
class Format:
    """
    A form in which a calibration is written.

    title: what it is, for the help; file_name: of the file in the folder of the result; text:
    what is in the file. Both take the calibration; text raises nothing.
    """

    title: str
    file_name: Callable[[Calibration], str]
    text: Callable[[Calibration], str]


def preamble(calibration: Calibration, units: str = SI) -> tuple[str, ...]:
    """Return lines that say what the numbers mean: direction, frames, units, uncertainty."""
    parent, child = one_line(calibration.parent_frame), one_line(calibration.child_frame)
    std = np.sqrt(np.diag(calibration.covariance))
    position = ', '.join(f'{axis} {s * 1e3:.3f}' for axis, s in zip('xyz', std[:3], strict=True))
    turns = ', '.join(f'{axis} {math.degrees(s):.4f}'
                      for axis, s in zip('xyz', std[3:], strict=True))
    return (
        f'Hand-eye calibration {one_line(calibration.name)} ({one_line(calibration.method)}), '
        f'written by handeye_ros {__version__}.',
        f'The pose of {child} in {parent}: p_{parent} = T @ p_{child}, so it maps points of '
        f'{child} into {parent}.',
        f'Parent frame {parent}, child frame {child}. {units}',
        f'1 sigma of the position: {position} mm; of the rotation about the axes of {parent}: '
        f'{turns} degrees.')


def one_line(text: str) -> str:
    """Return a text without line ends, so that it cannot leave a comment."""
    return ' '.join(text.split())


def commented(calibration: Calibration, mark: str = '# ', units: str = SI) -> str:
    """Return the preamble as comment lines."""
    return ''.join(f'{mark}{line}\n' for line in preamble(calibration, units))


def numbers(values: Array) -> str:
    """Return numbers with blanks between, each with all its digits."""
    return ' '.join(repr(float(value)) for value in values)


def position(calibration: Calibration) -> Array:
    """Return the translation (3,) of the sensor in its parent (metres)."""
    return calibration.T_flange_sensor[:3, 3]


def quaternion(calibration: Calibration) -> Array:
    """Return the rotation (4,) of the sensor in its parent, x y z w."""
    return se3.quaternion(calibration.T_flange_sensor)


def matrix(calibration: Calibration) -> str:
    """Return T, row by row; numpy.loadtxt reads it."""
    rows = [numbers(row) + '\n' for row in calibration.T_flange_sensor]
    return commented(calibration) + '# The matrix T (4x4), row by row.\n' + ''.join(rows)


def as_json(calibration: Calibration) -> str:
    """Return the calibration as JSON; its "comment" says what a comment would."""
    T = calibration.T_flange_sensor
    values = {
        'comment': preamble(calibration),
        'name': calibration.name,
        'parent_frame': calibration.parent_frame,
        'child_frame': calibration.child_frame,
        'transform': transform_values(T),
        'rpy': se3.rpy(T).tolist(),
        'matrix': T.tolist(),
        'covariance': calibration.covariance.tolist(),
    }
    return json.dumps(values, indent=2) + '\n'
