# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""calibration.yaml: written whole, read back equal, damaged files refused by sentence."""
from __future__ import annotations

from dataclasses import replace
from functools import reduce
import math
import re

from calibrations import CALIBRATION, equal
from command import assert_refused, handeye
from handeye_ros import se3
from handeye_ros.data import Calibration, ClockEstimate, Quality, SampleReport
from handeye_ros.errors import InputError, UnwritableError
from handeye_ros.results import calibration_file, printed, truth
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
import yaml


@pytest.fixture
def path(tmp_path):
    return tmp_path / 'calibration.yaml'


def content_of(calibration, path):
    calibration_file.write_calibration(calibration, path)
    return yaml.safe_load(path.read_text())


def test_what_other_readers_take_from_it(path):
    content = content_of(CALIBRATION, path)
    assert content['transform']['rotation']['w'] >= 0
    assert content['rpy'] == pytest.approx(list(se3.rpy(CALIBRATION.T_flange_sensor)), abs=1e-15)
    assert content['covariance'][7] == CALIBRATION.covariance[1, 1]
    assert content['samples'][::2] == [
        {'stamp': 1700000000500000001, 'used': True, 'edge': 'p', 'residual': 1.9e-5},
        {'stamp': 1700000004500000001, 'used': False, 'reason': 'no edge in sight'}]
    assert content['provenance'].keys() == {'version', 'created', 'inputs', 'config'}
    assert 'p_flange = T @ p_laser' in path.read_text()


def test_a_path_whose_bytes_are_no_text_is_written_with_question_marks(path):
    inputs = [{'bag': b'/data/pl\xffate'.decode('utf-8', 'surrogateescape')}]
    content = content_of(replace(CALIBRATION, provenance={'inputs': inputs}), path)
    assert content['provenance']['inputs'] == [{'bag': '/data/pl?ate'}]


finite = st.floats(-1e6, 1e6)
words = st.text(st.characters(codec='utf-8', exclude_categories=('Cs', 'Cc')), max_size=20)


@st.composite
def calibrations(draw):
    vector = np.array(draw(st.tuples(*[st.floats(-3.1, 3.1)] * 3)))
    T = se3.transform(se3.exp_rotation(vector), np.array(draw(st.tuples(finite, finite, finite))))
    covariance = np.array(draw(st.lists(finite, min_size=36, max_size=36))).reshape(6, 6)
    covariance[np.diag_indices(6)] = np.abs(covariance.diagonal())
    count = st.integers(0, 1000)
    quality = draw(st.builds(Quality, count, count, finite, finite, words, finite))
    samples = draw(st.lists(st.builds(
        SampleReport, st.integers(0, 2 ** 63), st.booleans(), words, st.none() | finite, words),
        max_size=4))
    plain = st.recursive(finite | words | st.integers() | st.booleans(), lambda inner: st.lists(
        inner, max_size=3) | st.dictionaries(words, inner, max_size=3), max_leaves=5)
    target = draw(st.dictionaries(words, plain, max_size=3))
    provenance = {'version': draw(words), 'created': draw(words), 'config': {}}
    offset = draw(st.none() | st.builds(ClockEstimate, finite, finite))
    names = [draw(words) for _ in range(4)]
    return Calibration(*names, T, covariance, target, quality, tuple(samples), provenance, offset)


@given(calibration=calibrations())
def test_any_calibration_is_read_back_equal(tmp_path_factory, calibration):
    path = tmp_path_factory.mktemp('any') / 'calibration.yaml'
    calibration_file.write_calibration(calibration, path)
    assert equal(calibration_file.read_calibration(path), calibration)


@pytest.mark.parametrize('keys', [
    'format', 'transform.rotation.w', 'covariance', 'quality.samples_used', 'samples'])
@pytest.mark.parametrize('damage', ['missing', 'of another type'])
def test_a_missing_or_wrong_key_is_named(path, keys, damage):
    content = content_of(CALIBRATION, path)
    *sections, last = keys.split('.')
    section = reduce(dict.__getitem__, sections, content)
    if damage == 'missing':
        del section[last]
    else:
        section[last] = 7 if isinstance(section[last], str | list | dict) else 'seven'
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(InputError, match=f'(?s){path} cannot be used: {keys}'):
        calibration_file.read_calibration(path)


@pytest.mark.parametrize(('old', 'new', 'reason'), [
    ('calibration/1', 'calibration/2', 'newer than this version'),
    ('handeye_ros/calibration/1', 'easy_handeye/1', 'expected handeye_ros/calibration/1'),
    ('x: 0.0123', 'x: .nan', 'transform.translation.x is nan'),
    ('x: 0.0123', f'x: 1{400 * "0"}', 'transform.translation.x is 1'),
    ('rpy: [', f'rpy: [1{400 * "0"}, ', 'does not hold 3 numbers'),
    ('w: 0', 'w: 2', 'a quaternion of length'),
    ('used: true', 'used: 1', r'samples\[0\].used is 1'),
    ('covariance: [', 'covariance: [1.0, ', 'covariance does not hold 36 numbers'),
    ('covariance: [', 'covariance: [[', 'not valid YAML'),
    ('covariance: [', 'covariance: [-', 'covariance has a negative variance'),
    ('rpy: [', 'rpy: [0.0, ', 'rpy does not hold 3 numbers'),
    ('rpy: [-0.88', 'rpy: [-0.78', r'rpy and transform.rotation differ by 5\.73'),
])
def test_damaged_values_are_refused_with_a_reason(path, old, new, reason):
    calibration_file.write_calibration(CALIBRATION, path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=reason):
        calibration_file.read_calibration(path)


@pytest.mark.parametrize(('key', 'value', 'reason'), [
    ('pose', 'x', "pose is 'x', expected a mapping"), ('edge_angle', 'x', "edge_angle is 'x'"),
    ('radius_std', math.nan, 'radius_std is nan'), ('centre', {}, 'centre does not hold 3'),
    ('joint', {'state': [1.0, math.nan]}, r'joint\.state\[1\] is nan')])
def test_a_damaged_estimate_is_named_by_every_verb_that_reads_it(path, key, value, reason):
    damaged = replace(CALIBRATION, target={**CALIBRATION.target, key: value})
    calibration_file.write_calibration(damaged, path)
    run = handeye('report', path.parent, cwd=path.parent)
    assert_refused(run, 2, f'{path} cannot be used: target.')
    assert re.search(reason, run.stderr)


@given(junk=st.binary(max_size=200))
def test_any_bytes_are_refused(tmp_path_factory, junk):
    path = tmp_path_factory.mktemp('junk') / 'calibration.yaml'
    path.write_bytes(junk)
    with pytest.raises(InputError):
        calibration_file.read_calibration(path)


def test_a_file_is_written_whole_or_not_at_all(tmp_path, path):
    path.write_text('old')
    calibration_file.write_calibration(replace(CALIBRATION, provenance={}), path)
    assert calibration_file.read_calibration(path).provenance['created'].endswith('+00:00')
    (tmp_path / 'folder' / 'inside').mkdir(parents=True)
    for place in (path / 'x.yaml', tmp_path / 'folder'):
        with pytest.raises(UnwritableError, match='cannot write'):
            calibration_file.write_calibration(CALIBRATION, place)
    assert sorted(p.name for p in tmp_path.iterdir()) == ['calibration.yaml', 'folder']


def test_sigma_of_roll_pitch_yaw_is_that_of_drawn_rotations():
    T = CALIBRATION.T_flange_sensor
    draws = np.random.default_rng(6).multivariate_normal(
        np.zeros(3), CALIBRATION.covariance[3:, 3:], size=4000)
    rpy = [se3.rpy(se3.perturb(T, np.concatenate([np.zeros(3), d]))) for d in draws]
    assert printed.rpy_std(T, CALIBRATION.covariance[3:, 3:]) == pytest.approx(
        np.std(rpy, axis=0), rel=0.05)


def test_samples_not_used_for_one_reason_are_one_line_whatever_its_numbers():
    reasons = [*(f'sample {k} is excluded by samples.exclude' for k in range(1, 13)),
               '8 mm and 1.0 degrees from sample 3: it brings nothing new',
               '12 mm and -0.5 degrees from sample 4: it brings nothing new']
    samples = tuple(SampleReport(k, False, reason=reason) for k, reason in enumerate(reasons))
    facts = printed.facts(replace(CALIBRATION, samples=samples))
    lines = [text for name, text in facts if not name]
    assert lines == [f'12 rejected, the first: {reasons[0]}',
                     f'2 rejected, the first: {reasons[12]}']


def test_errors_against_the_truth_are_those_of_known_differences():
    T = CALIBRATION.T_flange_sensor
    assert truth.errors_against(T, T) == truth.TransformErrors(0.0, 0.0, 0.0)
    shifted = se3.perturb(T, np.array([3e-3, 0, 4e-3, 0, 0, 0]))
    errors = truth.errors_against(shifted, T)
    assert errors.translation == pytest.approx(5e-3)
    assert errors.rotation == pytest.approx(0.0, abs=1e-12)
    assert errors.mapped_points == pytest.approx(5e-3)
    turned = T @ se3.transform(se3.exp_rotation(np.array([0.0, 0.01, 0.0])), np.zeros(3))
    errors = truth.errors_against(turned, T)
    assert errors.rotation == pytest.approx(0.01)
    # turned about y, a point moves by its distance times the angle
    assert errors.mapped_points == pytest.approx(0.01 * math.sqrt(0.175 ** 2 + (
        0.02 ** 2 + 0.015 ** 2) / 3), rel=3e-3)
