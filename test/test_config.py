# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The configuration: what may be put where, and what is said when it may not."""
from __future__ import annotations

from handeye_ros.config import (
    Config,
    flatten,
    from_provenance,
    load,
    Parameter,
    parameters,
    TargetConfig,
    with_assignments,
    with_values,
)
from handeye_ros.errors import BadValueError, InputError, UnknownKeyError
from hypothesis import example, given
from hypothesis import strategies as st
import numpy as np
import pytest

KEYS = {p.key: p for p in parameters()}


def values_of(parameter: Parameter) -> st.SearchStrategy[object]:
    """Return values that a key takes."""
    if parameter.key == 'save.formats':
        return st.lists(st.sampled_from(parameter.choices), min_size=1, max_size=7)
    if parameter.key == 'profile.axes':
        axes = st.sampled_from(parameter.choices)
        return st.lists(axes, min_size=2, max_size=2).filter(lambda two: two[0][-1] != two[1][-1])
    if isinstance(parameter.default, tuple):
        numbers = st.integers if isinstance(parameter.minimum, int) else st.floats
        item = numbers(parameter.minimum, parameter.maximum)
        return st.sampled_from(parameter.length or (0, 1, 5)).flatmap(
            lambda n: st.lists(item, min_size=n, max_size=n))
    if parameter.choices:
        return st.sampled_from(parameter.choices)
    kind = type(parameter.default)
    if kind is bool:
        return st.booleans()
    if kind is str:
        letters = st.characters(codec='utf-8', exclude_categories=['C', 'Z'])
        return st.text(letters, min_size=1, max_size=20)
    if kind is int:
        return st.integers(int(parameter.minimum or 0), int(parameter.maximum or 0))
    return st.floats(parameter.minimum, parameter.maximum)


some_values = st.sets(st.sampled_from(sorted(KEYS))).flatmap(
    lambda keys: st.fixed_dictionaries({key: values_of(KEYS[key]) for key in sorted(keys)}))


@given(some_values)
@example({'noise.robot_class': 'calibrated', 'noise.robot_smooth': 1e-3})
def test_values_put_in_come_out_again(values: dict[str, object]) -> None:
    config = with_values(Config(), values, 'test')
    flat = flatten(config)
    assert {key: flat[key] for key in values} == values
    assert with_values(Config(), flat, 'test') == config == from_provenance(flat)
    rest, keys_put_in = flatten(Config()), set(values)
    if values.get('noise.robot_class'):
        keys_put_in.add('noise.robot_smooth')  # which the class states
    assert {k: v for k, v in flat.items() if k not in keys_put_in} == {
        k: v for k, v in rest.items() if k not in keys_put_in}


@pytest.mark.parametrize('parameter', KEYS.values(), ids=lambda p: p.key)
def test_defaults_pass_their_limits_and_ranges_have_ends(parameter):
    key, values = parameter.key, flatten(Config())  # without those that must be set
    assert all(flatten(with_values(Config(), {k: values[k]}, 'test'))[k] == values[k]
               for k in {key} & values.keys())
    assert parameter.description.endswith('.')
    low, high, kind = parameter.minimum, parameter.maximum, type(parameter.default)
    if kind not in (int, float):
        return
    assert low is not None and high is not None and low < high
    for inside in (low, high):
        assert flatten(with_values(Config(), {key: kind(inside)}, 't'))
    for outside in (low - 1, high + 1):
        with pytest.raises(BadValueError, match=key):
            with_values(Config(), {key: kind(outside)}, 't')


@pytest.mark.parametrize(('key', 'hint'), [
    ('noise.sensr', '; did you mean "noise.sensor"'), ('unit', '; did you mean "profile.unit"'),
    ('zzzzzz', '')])
def test_an_unknown_key_suggests_the_nearest(key: str, hint: str) -> None:
    with pytest.raises(UnknownKeyError) as caught:
        with_values(Config(), {key: 1.0}, 'plate.yaml')
    assert str(caught.value).startswith(f'unknown key "{key}" in plate.yaml{hint}')
    assert ('did you mean' in str(caught.value)) == bool(hint)


@pytest.mark.parametrize(('key', 'value', 'expected'), [
    ('noise.sensor', '3e-5x', 'a number from 1e-09 to 0.01 m'),
    ('noise.sensor', 10**400, 'a number from 1e-09 to 0.01 m'),
    ('noise.sensor', 1.0, 'a number from 1e-09 to 0.01 m'),
    ('noise.sensor', None, 'a number from 1e-09 to 0.01 m'),
    ('limits.residual', float('inf'), 'a number from 0 to 1 m'),
    ('sampling.min_points', 20.0, 'a whole number from '),
    ('sampling.mode', 1, 'one of still'),
    ('name', 5, 'str'),
    ('profile.unit', 'cm', 'one of m, mm'),
    ('profile.range_sign', 0, 'one of 1, -1'),
    ('profile.axes', 'xz', 'a list of 2 values'),
    ('profile.axes', ['x', '-x'], 'two different axes'),
    ('target.size', [0.2], 'a list of 0 or 2 values'),
    ('target.size', [0.2, -0.1], 'a number from 0'),
    ('calibration_type', 'eye_to_hand', 'one of eye_in_hand, eye_on_base'),
    ('noise', {'sensor': 1.0}, ''),
    ('pose_topic', ' ', 'without control characters, or blanks'),
    ('pose_topic', '', 'a text such as flange_pose'),
])
def test_a_wrong_value_is_refused_by_key(key: str, value: object, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        with_values(Config(), {key: value}, 'test')
    assert key in str(caught.value) and expected in str(caught.value)
    assert caught.value.exit_code == 2


VALID = [(text, {'name': 'new'}) for text in (
    '/**: {ros__parameters: {name: new}}',
    '/cell_1: {handeye: {ros__parameters: {name: new}}}',
    '/**/handeye: {ros__parameters: {name: new}}',
    '/cell_1/*: {ros__parameters: {name: new}}',
    '/**: {ros__parameters: {name: new}}\n/my_node: {ros__parameters: {name: other}}',
    '/driver: {ros__parameters: {port: 3}}\n/handeye: {ros__parameters: {name: new}}')]
VALID += [
    ('/**:\n  ros__parameters: {name: all, pose_topic: p}\n'  # the node's own go beyond them
     'handeye:\n  ros__parameters: {name: mine}\n'
     'other:\n  ros__parameters: {name: theirs, whatever: 1}\n',
     {'name': 'mine', 'pose_topic': 'p'}),
    ('"/**":\n  ros__parameters:\n    use_sim_time: true\n    noise: {sensor: 1.0e-5}\n'
     '    noise.robot_translation: 0.0001\n    target:\n      size: [0.2, 0.15]\n',
     {'noise.sensor': 1e-5, 'noise.robot_translation': 1e-4, 'target.size': [0.2, 0.15]}),
    ('/**: {ros__parameters: {}}', {}),
    ('/**:\n  ros__parameters:\n    name: new\n    noise:\n      # sensor: 1e-5\n',
     {'name': 'new'}),
    ('/**:\n  ros__parameters:\n    record.sensor_serial: 007\n    record: {note: no}\n',
     {'record.sensor_serial': '007', 'record.note': 'no'}),
    # as `ros2 param dump` prints it: empty lists without a type are null there
    ('/handeye:\n  ros__parameters:\n    name: cell\n    output_dir: /tmp/results\n'
     '    qos_overrides:\n      /clock:\n        subscription: {depth: 1}\n'
     '    start_type_description_service: true\n    target: {size: null}\n'
     '    use_sim_time: false\n', {'name': 'cell', 'output_dir': '/tmp/results'})]


@pytest.mark.parametrize(('text', 'values'), VALID)
def test_a_parameter_file_is_put_into_a_configuration(tmp_path, text, values):
    path = tmp_path / 'c.yaml'
    path.write_text(text)
    assert load(path) == with_values(Config(), values, 'test')
    base = with_values(Config(), {'limits.points': 0.5}, 'test')
    if 'limits' not in text:
        assert load(path, base) == with_values(base, values, 'test')


@pytest.mark.parametrize(('content', 'words'), [
    *((text, 'ros__parameters') for text in (
        '', 'name: plate', '- 1', '/**:\n  ros__parameters:\n', '"just words"')),
    ('/**: {ros__parameters: [1, 2]}', 'c.yaml'),
    *((content, 'c.yaml') for content in ('a: [1', b'\xff\xfe\x00', None)),
    ('/a: {ros__parameters: {name: a}}\n/b: {ros__parameters: {name: b}}',
     '/a, /b, and none of them is "handeye"'),
    ('/camera: {ros__parameters: {target: {type: sphere}}}', '/camera, and none'),
    ('/1/handeye: {ros__parameters: {name: a}}\n/2/handeye: {ros__parameters: {name: b}}',
     'keep those of one'),
    ('/**: {ros__parameters: {1: 2}}', '"1"'),
    ('/**:\n  ros__parameters:\n    noise: {sensor: 1.0e-4}\n    noise: {flatness: 1.0e-5}\n',
     'key "noise" stands twice'),
    ('/**:\n  ros__parameters:\n    noise.sensor: 1e-5\n    noise: {sensor: 2e-5}\n',
     'key "noise.sensor" stands twice'),
    ('/**: {ros__parameters: {record.note: [1, 2]}}', 'a text: write it in quotes'),
    ('/**: {ros__parameters: {sampling: {still: 1.0}}}',
     r'"sampling.still" in .*c.yaml; did you mean')])
def test_a_file_of_another_form_is_refused(tmp_path, content, words):
    path = tmp_path / 'c.yaml'
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError, match=words):
        load(path)


def test_a_configuration_can_be_made_in_code() -> None:
    config = Config(target=TargetConfig(type='plate', size=[np.float64(0.2), 1]))  # type: ignore
    assert config == with_values(
        Config(), {'target.type': 'plate', 'target.size': [0.2, 1.0]}, 'test')
    assert [type(length) for length in config.target.size] == [float, float]


@pytest.mark.parametrize(('text', 'value'), [
    ('noise.sensor=3e-5', 3e-5), ('limits.residual=1', 1.0), ('samples.exclude=[3, 7]', [3, 7]),
    ('name="2024"', '2024'), ('name=', ''), ('target.size=[]', []),
    ('profile.axes=[-x, z]', ['-x', 'z']), ('profile.range_sign=-1', -1),
    ('verify.lengths=[15mm, 0.005]', [0.015, 0.005]), ('verify.radius=2 cm', 0.02),
    ('verify.radius=2.cm', 0.02), ('verify.radius=2E4um', 0.02),
    ('verify.angle_tolerance=0.5deg', np.pi / 360),
    ('verify.near=[-300mm, 0, 1e2 mm, 0.2m]', [-0.3, 0.0, 0.1, 0.2]),
    ('target.radius=20000um', 0.02), ('noise.sensor=30\u00b5m', 3e-5),
    ('noise.flatness=5 \u03bcm', 5e-6), ('noise.robot_rotation=0.07mrad', 7e-5),
    ('profile.exposure=20ms', 0.02), ('time_offset_std=5ms', 0.005),
    ('rotation_lag_std=1ms', 0.001), ('verify.reference=[500mm, 0, 2cm]', [0.5, 0.0, 0.02]),
    ('record.note=20mm', '20mm'), ('name=3mm', '3mm'), ('record.sensor_serial=007', '007'),
    ('record.note=lens: 21 #2', 'lens: 21 #2'), ('record.operator=no', 'no')])
def test_assignments_are_read_as_yaml_and_numbers_with_their_unit(text: str, value: object
                                                                  ) -> None:
    read = flatten(with_assignments(Config(), [text]))[text.partition('=')[0]]
    assert read == (pytest.approx(value, rel=1e-12) if isinstance(value, float) else value)


@pytest.mark.parametrize('text', ['noise.sensor', '', 'name=[', 'noise.sensor=abc', 'nme=x',
                                  'verify.radius=5mm5', 'pose_topic='])
def test_a_bad_assignment_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        with_assignments(Config(), [text])


@pytest.mark.parametrize(('text', 'words'), [
    ('noise.sensor=.nan', 'a number from 1e-09 to 0.01 m'),
    ('time_offset=12mm', 'a number from -10 to 10 s'),
    ('time_offset_std=2', 'a number from 1e-06 to 1 s'),
    ('verify.reference=[60, 0, 0]', 'a number from -50 to 50 m'),
    ('page.port=8765.5', 'a whole number from 0 to 65535'),
    ('verify.tolerance=0.3', 'a number from 1e-09 to 0.02 m'),  # mm are meant
    ('verify.angle_tolerance=0.1', 'a number from 1e-09 to 0.05 rad')])
def test_what_a_key_takes_is_told_with_its_unit(text: str, words: str) -> None:
    with pytest.raises(BadValueError, match=f'expected {words}$'):
        with_assignments(Config(), [text])


def test_the_class_of_a_robot_sets_its_accuracy_unless_that_is_given() -> None:
    key = 'noise.robot_class'
    assert with_values(Config(), {key: 'calibrated'}, 't').noise.robot_smooth == 5e-5
    assert with_values(Config(), {key: 'unknown', 'noise.robot_smooth': 1e-5}, 't'
                       ).noise.robot_smooth == 1e-5
    texts = ['noise.robot_smooth=1.0e-5', 'noise.robot_class=unknown']
    assert with_assignments(Config(), texts) == with_assignments(Config(), texts[::-1])
    assert with_assignments(Config(), texts).noise.robot_smooth == 1e-5
