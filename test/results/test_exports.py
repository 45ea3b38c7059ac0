# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Every form in which a calibration is written is read back by a reader of its own."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
import json
from pathlib import Path
import re
import shutil
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

from calibrations import CALIBRATION
from command import handeye
from handeye_ros import config, se3
from handeye_ros.data import Array
from handeye_ros.errors import InputError, UnknownNameError, UnwritableError
from handeye_ros.notations import notation_of
from handeye_ros.results import calibration_file, exports
from hypothesis import example, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
import yaml

urdf_parser_py = pytest.importorskip('urdf_parser_py.urdf', reason='needs urdf_parser_py')


def from_xyzw(translation: list[float], rotation: list[float]) -> Array:
    """Return a transform as scipy, not the package, makes it."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(rotation).as_matrix(), translation
    return T


def from_values(values: dict[str, Any]) -> tuple[Array, str, str]:
    place, turn = values['transform']['translation'], values['transform']['rotation']
    return (from_xyzw([place[k] for k in 'xyz'], [turn[k] for k in 'xyzw']),
            values['parent_frame'], values['child_frame'])


def read_urdf(text: str) -> tuple[Array, str, str]:
    robot = urdf_parser_py.URDF.from_xml_string(text.encode())
    (joint,) = robot.joints
    assert joint.type == 'fixed' and [link.name for link in robot.links] == [joint.child]
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler('xyz', joint.origin.rpy).as_matrix()
    T[:3, 3] = joint.origin.xyz
    return T, joint.parent, joint.child


def read_launch(text: str) -> tuple[Array, str, str]:
    code = re.sub(r'^from launch.*$', '', text, flags=re.MULTILINE)
    names = {'LaunchDescription': lambda entities: entities,
             'Node': lambda **options: SimpleNamespace(**options)}
    exec(code, names)
    (node,) = names['generate_launch_description']()  # type: ignore[operator]
    assert (node.package, node.executable) == ('tf2_ros', 'static_transform_publisher')
    assert re.fullmatch('[a-z0-9_]+', node.name, re.IGNORECASE)
    pairs = dict(zip(node.arguments[::2], node.arguments[1::2], strict=True))
    place, turn = ([float(pairs.pop(f'--{key}')) for key in keys] for keys in (
        'xyz', ('qx', 'qy', 'qz', 'qw')))
    frames = pairs.pop('--frame-id'), pairs.pop('--child-frame-id')
    assert not pairs
    return from_xyzw(place, turn), *frames


def read_easy_handeye2(text: str) -> tuple[Array, str, str]:
    """Read a file as easy_handeye2's load_calibration: each key goes into a typed message."""
    known = {'name': str, 'calibration_type': str, 'robot_base_frame': str,
             'robot_effector_frame': str, 'tracking_base_frame': str,
             'tracking_marker_frame': str, 'freehand_robot_movement': bool,
             'move_group_namespace': str, 'move_group': str}
    content = yaml.full_load(text)
    assert content.keys() == {'parameters', 'transform'}
    parameters = content['parameters']
    assert all(type(value) is known[key] for key, value in parameters.items())
    parent = {'eye_in_hand': 'robot_effector_frame', 'eye_on_base': 'robot_base_frame'}
    T, _, _ = from_values({**content, 'parent_frame': '', 'child_frame': ''})
    return T, parameters[parent[parameters['calibration_type']]], parameters['tracking_base_frame']


def read_matrix(text: str) -> tuple[Array, None, None]:
    return np.loadtxt(text.splitlines()), None, None


def read_json(text: str) -> tuple[Array, str, str]:
    content = json.loads(text)
    T, parent, child = from_values(content)
    np.testing.assert_allclose(content['matrix'], T, rtol=0, atol=1e-12)
    return T, parent, child


def read_robot(text: str, vendor: str) -> tuple[Array, None, None]:
    """Return what the last line says, its numbers in their order."""
    line = re.sub('[A-Za-z_]+[_0-9]*', ' ', text.splitlines()[-1])
    numbers = np.array([float(v) for v in re.findall(r'-?[0-9]+[.][0-9]+', line)])
    T, notation = np.eye(4), notation_of(vendor)
    T[:3, :3] = notation.to_rotation(numbers[None, 3:]).as_matrix()[0]
    T[:3, 3] = numbers[:3] * (1e-3 if notation.length_unit == 'mm' else 1.0)
    return T, None, None


ROBOTS = ('kuka', 'fanuc', 'abb', 'ur', 'staubli', 'yaskawa')
READERS: dict[str, Callable[[str], tuple[Array, str | None, str | None]]] = {
    'yaml': lambda text: from_values(yaml.safe_load(text)), 'urdf': read_urdf,
    'launch': read_launch, 'easy_handeye2': read_easy_handeye2, 'matrix': read_matrix,
    'json': read_json,
    **{name: partial(read_robot, vendor=name) for name in ROBOTS}}

FINITE = st.floats(-10, 10)
QUATERNIONS = st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(
    lambda q: np.linalg.norm(q) > 0.1)
FRAMES = st.text(st.characters(blacklist_categories=('C', 'Z')), min_size=1, max_size=8)
UPRIGHT = 0.5 ** 0.5


@pytest.mark.parametrize('name', READERS)
@settings(max_examples=20)
@given(place=st.tuples(FINITE, FINITE, FINITE), turn=QUATERNIONS, frames=st.tuples(FRAMES, FRAMES),
       on_base=st.booleans())
@example((0.0, 0.0, 0.1), [0.0, UPRIGHT, 0.0, UPRIGHT], ('tool0', 'my laser'), False)
@example((0.0, 0.0, 0.1), [1e-9, UPRIGHT, 0.0, UPRIGHT], ("it's", 'a"<&--b>'), False)
@example((0.0, 0.0, 0.1), [0.1, UPRIGHT, 0.1, UPRIGHT + 1e-8], ('\\', '{x}$(y)#'), True)
def test_what_is_written_reads_back(name, place, turn, frames, on_base):
    calibration = replace(
        CALIBRATION, T_flange_sensor=from_xyzw(list(place), turn), parent_frame=frames[0],
        child_frame=frames[1], provenance={'config': {
            **CALIBRATION.provenance['config'],
            'calibration_type': 'eye_on_base' if on_base else 'eye_in_hand'}})
    text = exports.FORMATS[name].text(calibration)
    T, parent, child = READERS[name](text)
    assert ('set_tcp(' in text) == (name == 'ur' and not on_base)
    digits = 2e-7 if name in ROBOTS else 1e-9  # as a pendant takes them
    np.testing.assert_allclose(T, calibration.T_flange_sensor, rtol=0, atol=digits)
    assert parent in (frames[0], None) and child in (frames[1], None)


def test_no_name_of_a_frame_breaks_a_file(tmp_path: Path) -> None:
    named = replace(CALIBRATION, parent_frame='tool---0', child_frame='laser\nx: [')
    exports.save_all(named, tmp_path, ('yaml', 'urdf'))
    assert calibration_file.read_calibration(tmp_path / 'calibration.yaml').child_frame == (
        named.child_frame)
    ElementTree.parse(tmp_path / 'sensor.urdf.xacro')


def test_all_is_saved_and_said_with_its_place(tmp_path: Path) -> None:
    assert {*config.SAVE_FORMATS} == {*exports.FORMATS}
    words = exports.save_all(CALIBRATION, tmp_path / 'a' / 'b', config.SAVE_FORMATS)
    files = [*map(Path, words.removeprefix('wrote ').split(', '))]
    assert sorted(files) == sorted((tmp_path / 'a' / 'b').iterdir())
    assert len(files) == len(config.SAVE_FORMATS)
    assert all(path.is_absolute() for path in files)
    assert calibration_file.read_calibration(files[0]).provenance['created']


def kept(folder: Path) -> list[Path]:
    """Return the folders of previous results, oldest first."""
    return sorted((folder / 'history').glob('*'))


def test_a_former_result_is_kept_whole(tmp_path: Path) -> None:
    exports.save_all(CALIBRATION, tmp_path, ['urdf', 'json'])
    texts = {path.name: path.read_text() for path in tmp_path.iterdir()}
    (tmp_path / 'notes.txt').write_text('mine')
    moved = replace(CALIBRATION, T_flange_sensor=se3.inverse(CALIBRATION.T_flange_sensor))
    words = exports.save_all(moved, tmp_path, ['urdf'])
    previous, = kept(tmp_path)
    assert {path.name: path.read_text() for path in previous.iterdir()} == texts
    # what would tell of the former answer beside the new one is gone
    assert {path.name for path in tmp_path.iterdir()} == {
        'calibration.yaml', 'sensor.urdf.xacro', 'notes.txt', 'history'}
    assert words.endswith(f'; the previous result is kept in {previous}')
    words = exports.save_all(moved, tmp_path, ())
    first, second = kept(tmp_path)
    assert first == previous and words.endswith(str(second))
    (tmp_path / 'another.calib').write_text('of another sensor')
    exports.save_all(moved, tmp_path, ['easy_handeye2'])
    assert (tmp_path / 'another.calib').read_text() == 'of another sensor'


def test_a_former_result_that_is_brought_back_is_kept_once_more(tmp_path: Path) -> None:
    first, second = (replace(CALIBRATION, name=name) for name in ('first', 'second'))
    exports.save_all(first, tmp_path, ('yaml',))
    exports.save_all(second, tmp_path, ('yaml',))
    former, = kept(tmp_path)
    shutil.copy2(former / 'calibration.yaml', tmp_path)  # with its time
    exports.save_all(second, tmp_path, ('yaml',))
    assert len(kept(tmp_path)) == 2


def test_an_export_keeps_what_was_there(tmp_path: Path) -> None:
    file = tmp_path / 'mine.xml'
    assert exports.export(CALIBRATION, 'urdf', file) == f'wrote {file}'
    text = file.read_text()
    assert exports.export(CALIBRATION, 'urdf', file) == f'saved already: {file}'
    assert not kept(tmp_path)
    exports.export(CALIBRATION, 'matrix', file)
    previous, = kept(tmp_path)
    assert (previous / 'mine.xml').read_text() == text
    assert file.read_text() == exports.FORMATS['matrix'].text(CALIBRATION)


def test_an_unknown_format_and_an_unwritable_place_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match='there is no format "udf"; did you mean "urdf"'):
        exports.save_all(CALIBRATION, tmp_path, ['udf'])
    assert not list(tmp_path.iterdir())
    (tmp_path / 'file').write_text('')
    with pytest.raises(UnwritableError, match='choose another place'):
        exports.save_all(CALIBRATION, tmp_path / 'file', ())


def test_a_frame_without_a_name_is_not_exported() -> None:
    with pytest.raises(InputError, match='parent_frame and child_frame .* must be names'):
        exports.FORMATS['urdf'].text(replace(CALIBRATION, parent_frame=''))


def test_the_verb_exports_beside_the_calibration(tmp_path: Path) -> None:
    exports.save_all(CALIBRATION, tmp_path / 'a', ())
    run = handeye('export', 'a', '--format', 'urdf', cwd=tmp_path)
    file = tmp_path / 'a' / 'sensor.urdf.xacro'
    assert (run.returncode, run.stdout) == (0, f'wrote {file}\n'), run.stderr
    T, *_ = read_urdf(file.read_text())
    np.testing.assert_allclose(T, CALIBRATION.T_flange_sensor, rtol=0, atol=1e-9)
    run = handeye('export', 'a/calibration.yaml', '--format', 'matrix', '--out', '-', cwd=tmp_path)
    np.testing.assert_allclose(read_matrix(run.stdout)[0], T, rtol=0, atol=1e-9)
