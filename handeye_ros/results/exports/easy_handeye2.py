"""
A calibration as easy_handeye2 saves it, for its publisher and for what reads its files.

Its loader opens ~/.ros2/easy_handeye2/calibrations/<name>.calib and puts every key into a message
easy_handeye2_msgs/HandeyeCalibration: an unknown key fails, a missing one keeps its default. So
the keys are those that its own tools set and all its versions know (easy_handeye2,
handeye_calibration.py).
"""
from __future__ import annotations

from handeye_ros.config import BASE_FRAME, Config
from handeye_ros.data import Calibration
from handeye_ros.results.calibration_file import transform_values
from handeye_ros.results.exports.format import commented, one_line
import yaml

PLACE = '~/.ros2/easy_handeye2/calibrations'
TARGET_FRAME = 'handeye_target'  # ours has no name in the robot's tree


def file_name(calibration: Calibration) -> str:
    """Return the name under which easy_handeye2 looks for it."""
    return f'{_name(calibration)}.calib'


def _name(calibration: Calibration) -> str:
    return one_line(calibration.name).replace('/', '_')


def text(calibration: Calibration) -> str:
    """Return what is in the file."""
    config = calibration.provenance.get('config', {})
    on_base = config.get('calibration_type') == 'eye_on_base'
    robot = {'robot_base_frame': config.get('robot_base_frame') or BASE_FRAME,
             'robot_effector_frame': config.get('robot_effector_frame',
                                                Config.robot_effector_frame)}
    robot['robot_base_frame' if on_base else 'robot_effector_frame'] = calibration.parent_frame
    values = {
        'parameters': {
            'name': _name(calibration),
            'calibration_type': 'eye_on_base' if on_base else 'eye_in_hand',
            **robot,
            'tracking_base_frame': calibration.child_frame,
            'tracking_marker_frame': TARGET_FRAME,
            'freehand_robot_movement': True,
        },
        'transform': transform_values(calibration.T_flange_sensor)}
    return (f'{commented(calibration)}# For easy_handeye2: its place is {PLACE}/'
            f'{file_name(calibration)}\n'
            + str(yaml.safe_dump(values, sort_keys=False, allow_unicode=True)))
