"""A calibration for programs that know no ROS: a 4x4 matrix, and JSON."""
from __future__ import annotations

import json

from handeye_ros import se3
from handeye_ros.data import Calibration
from handeye_ros.results.calibration_file import transform_values
from handeye_ros.results.exports.format import commented, numbers, preamble


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
