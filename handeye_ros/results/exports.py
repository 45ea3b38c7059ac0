# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Writes a calibration in every format, and keeps the files of the previous one.

A 4x4 matrix and JSON; the tool frame as it is typed at the pendant of a robot, or put into its
program; for ROS a joint of a URDF, static_transform_publisher and the file of easy_handeye2.

The loader of easy_handeye2 opens ~/.ros2/easy_handeye2/calibrations/<name>.calib and puts every
key into a message easy_handeye2_msgs/HandeyeCalibration: an unknown key fails, a missing one keeps
its default. So the keys are those that its own tools set and all its versions know (easy_handeye2,
handeye_calibration.py).
"""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
import json
from pathlib import Path
import re
import shutil
from types import MappingProxyType

from handeye_ros import se3
from handeye_ros.data import Calibration
from handeye_ros.errors import InputError, looked_up
from handeye_ros.notations import notation_of
from handeye_ros.output import folder_time, write_atomically, write_errors_for, yaml_text
from handeye_ros.results import calibration_file
from handeye_ros.results.calibration_file import config_of, one_line, preamble
from handeye_ros.results.templates import rendered
import numpy as np
from scipy.spatial.transform import Rotation

YAML = 'yaml'
REPORT_FILE = 'report.html'
HISTORY_FOLDER = 'history'  # the folder of previous results, each in a folder named after the time
MARKER_FRAME = 'handeye_target'  # our target has no frame in the robot's tree
DIGITS_OF_UNIT = {'mm': 4, 'm': 7, 'deg': 5, 'rad': 8, '': 9}
# By vendor: file, start of a comment, and what is typed at the pendant or put into a program; last
# what is so for a sensor beside the robot, where that differs: it is no tool.
PENDANTS = {
    'kuka': ('tool_kuka.dat', '; ', 'DECL FRAME SENSOR={{X {x},Y {y},Z {z},A {a},B {b},C {c}}}'),
    'fanuc': ('tool_fanuc.txt', '! ', 'X: {x} Y: {y} Z: {z} W: {w} P: {p} R: {r}'),
    'abb': ('tool_abb.mod', '! ', 'CONST pose sensor:=[[{xyz}],[{angles}]];'),
    'ur': ('tool_ur.script', '# ', 'set_tcp(p[{xyz},{angles}])', 'sensor = p[{xyz},{angles}]'),
    'staubli': ('tool_staubli.txt', '// ', '{{{x}, {y}, {z}, {rx}, {ry}, {rz}}}'),
    'yaskawa': ('tool_yaskawa.txt', '; ', '{xyz},{angles}'),
}


def as_json(calibration: Calibration) -> str:
    """Return the calibration as JSON, with the preamble under "comment"."""
    content = calibration_file.content_of(calibration)
    names = ('name', 'parent_frame', 'child_frame', 'transform', 'rpy')
    values = {
        'comment': preamble(calibration), **{name: content[name] for name in names},
        'matrix': calibration.T_flange_sensor, 'covariance': calibration.covariance}
    return json.dumps(values, indent=2, default=np.ndarray.tolist) + '\n'


def tool_frame(calibration: Calibration, vendor: str, comment_start: str, lines: Sequence[str]
               ) -> str:
    """
    Return the sensor's pose as named numbers, and as a line of a robot program.

    comment_start: the start of a comment; lines: with {xyz}, {angles}, and {x}, {a} and so on, the
    last one for a sensor beside the robot.
    """
    notation, T = notation_of(vendor), calibration.T_flange_sensor
    angles = np.ravel(notation.to_numbers(Rotation.from_matrix(T[:3, :3])))
    names = ('x', 'y', 'z', *notation.labels)
    units = [notation.length_unit] * 3 + [notation.angle_unit] * len(angles)
    values = [*T[:3, 3] * (1e3 if notation.length_unit == 'mm' else 1.0), *angles]
    texts = [f'{round(value, DIGITS_OF_UNIT[unit]) + 0.0:.{DIGITS_OF_UNIT[unit]}f}'  # no -0
             for value, unit in zip(values, units, strict=True)]
    rows = [*preamble(calibration, f'{notation.title}.'), *(
        f'{name.upper():3} {text} {unit}'.rstrip()
        for name, text, unit in zip(names, texts, units, strict=True))]
    line = lines[0] if config_of(calibration).in_hand else lines[-1]
    program = line.format(**dict(zip(names, texts, strict=True)), xyz=','.join(texts[:3]),
                          angles=','.join(texts[3:]))
    return ''.join(f'{comment_start}{row}\n' for row in rows) + f'{program}\n'


def filled_template(calibration: Calibration, template: str) -> str:
    """Return a calibration by a template in results/assets; raises InputError without frames."""
    if not (calibration.parent_frame and calibration.child_frame):
        raise InputError('parent_frame and child_frame of a calibration must be names, not empty')
    T = calibration.T_flange_sensor
    # ROS takes letters, digits and underscores in the name of a node
    node = 'publish_' + re.sub(r'\W', '_', calibration.child_frame, flags=re.ASCII)
    pose = zip(('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw'),
               (*T[:3, 3].tolist(), *se3.quaternion(T).tolist()), strict=True)
    return rendered(template, c=calibration, comment=preamble(calibration), node=node,
                    matrix=T.tolist(), pose=dict(pose), rpy=se3.rpy(T).tolist())


def easy_handeye2(calibration: Calibration) -> str:
    """Return the content of the file for easy_handeye2."""
    config, file = config_of(calibration), FORMATS['easy_handeye2'].file_name(calibration)
    parent = 'robot_effector_frame' if config.in_hand else 'robot_base_frame'
    content = {
        'parameters': {
            'name': file.removesuffix('.calib'),
            'calibration_type': config.calibration_type,
            'robot_base_frame': config.base_frame,
            'robot_effector_frame': config.robot_effector_frame,
            parent: calibration.parent_frame,
            'tracking_base_frame': calibration.child_frame,
            'tracking_marker_frame': MARKER_FRAME,
            'freehand_robot_movement': True,
        },
        'transform': se3.transform_values(calibration.T_flange_sensor)}
    header = (*preamble(calibration), 'For easy_handeye2: its place is '
              f'~/.ros2/easy_handeye2/calibrations/{file}')
    return ''.join(f'# {line}\n' for line in header) + yaml_text(content)


@dataclass(frozen=True)
class Format:
    """
    A file format of a calibration.

    name_pattern: name of the file in the folder of the result, with {name} of the calibration
    text: returns the content of the file
    """

    name_pattern: str
    text: Callable[[Calibration], str]

    def file_name(self, calibration: Calibration) -> str:
        """Return the name of the file in the folder of the result."""
        return self.name_pattern.format(name=one_line(calibration.name).replace('/', '_'))


FORMATS = {
    YAML: Format(calibration_file.NAME, calibration_file.text),
    **{name: Format(file, partial(filled_template, template=f'{file}.jinja')) for name, file in (
        ('urdf', 'sensor.urdf.xacro'), ('launch', 'static_transform.launch.py'),
        ('matrix', 'matrix.txt'))},
    'easy_handeye2': Format('{name}.calib', easy_handeye2),
    'json': Format('calibration.json', as_json),
    **{vendor: Format(file, partial(tool_frame, vendor=vendor, comment_start=start, lines=lines))
       for vendor, (file, start, *lines) in PENDANTS.items()},
}


def save_all(calibration: Calibration, folder: Path, formats: Sequence[str],
             others: Mapping[str, str] = MappingProxyType({})) -> str:
    """
    Write a calibration in all given formats, always also calibration.yaml; say where, as `write`.

    others: further texts of the answer by file name, which the calibration may name. The files of
    a previous result are kept in its history: nothing is lost, and all files of these names are of
    one answer. Raises UnknownNameError, InputError for frames without a name, and UnwritableError.
    """
    calibration = calibration_file.with_origin(calibration)
    chosen = [looked_up('format', name, FORMATS) for name in dict.fromkeys((YAML, *formats))]
    names_of_result = {REPORT_FILE, *(form.file_name(calibration) for form in FORMATS.values())}
    texts = {form.file_name(calibration): form.text(calibration) for form in chosen}
    return write({**others, **texts}, folder.expanduser().absolute(), names_of_result | {*others})


def export(calibration: Calibration, name: str, file: Path) -> str:
    """
    Write a calibration in one format; say where, as `write`.

    An existing file with other content is kept in the history. Raises as save_all.
    """
    file, text = file.expanduser().absolute(), looked_up('format', name, FORMATS).text(calibration)
    return write({file.name: text}, file.parent, {file.name})


def write(texts: Mapping[str, str], folder: Path, names_of_result: set[str]) -> str:
    """
    Write files in order into a folder, unless it has just these already; say where they are.

    texts: by the names of the files; names_of_result: of all files that belong to a result. Those
    of the previous one, also its report, are kept in the history of the folder, named after the
    time when they were replaced. A reader finds at each moment a whole file of each name. Raises
    UnwritableError.
    """
    files = [folder / name for name in texts]
    listed = ', '.join(map(str, files))
    history = folder / HISTORY_FOLDER / folder_time()
    with write_errors_for(folder):
        existing = {name: (folder / name).read_bytes() for name in names_of_result
                    if (folder / name).is_file()}
        if {name: content for name, content in existing.items() if name != REPORT_FILE} == {
                name: text.encode() for name, text in texts.items()}:
            return f'saved already: {listed}'
        if existing:
            history.mkdir(parents=True)
        for name in existing:
            shutil.copy2(folder / name, history / name)
            if name not in texts:
                (folder / name).unlink()
    for file, text in zip(files, texts.values(), strict=True):
        write_atomically(file, text)
    kept = f'; the previous result is kept in {history}' if existing else ''
    return f'wrote {listed}{kept}'
