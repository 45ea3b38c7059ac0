# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Serialised messages: read like other readers do, in every layout; no bytes break it."""
from __future__ import annotations

from pathlib import Path
import re

from command import ROOT
from handeye_ros import config as configs
from handeye_ros.bags.messages import (
    CHECK_COUNT,
    DATATYPES,
    pose_from_cdr,
    profile_count,
    profile_from_cdr,
    profile_from_cloud,
    ProfileReader,
    transforms_from_cdr,
)
from handeye_ros.config import ProfileConfig
from handeye_ros.data import EdgePoint
from handeye_ros.errors import UnusableMessageError
from handeye_ros.profiles.faces import face_features
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from recordings import cloud_message, header, new, transform
from recordings import TYPES as STORE
from ros_clouds import cloud, expected, field, METRES, points

CLOUD, POSE = 'sensor_msgs/msg/PointCloud2', 'geometry_msgs/msg/PoseStamped'
TF = 'tf2_msgs/msg/TFMessage'
STAMP = 3_000_000_005
F32, U8 = 7, 2
XZ, XYZ = {'x': (0, F32), 'z': (8, F32)}, {'x': (0, F32), 'y': (4, F32), 'z': (8, F32)}
X = np.array([-0.02, -0.01, 0.0, 0.01, 0.02, 0.03])
Z = np.array([0.171, 0.172, np.nan, 0.174, np.inf, -np.inf])


# -- serialised


def serialised(msg: object, kind: str = CLOUD, little_endian: bool = True) -> bytes:
    return bytes(STORE.serialize_cdr(msg, kind, little_endian=little_endian))


def message(frame_id: str = 'laser') -> object:
    columns = {'x': np.linspace(-0.02, 0.02, 50), 'a long name': np.zeros(50),
               'z': np.full(50, 0.17)}
    scan = cloud(columns, {'x': (0, F32), 'a long name': (4, U8), 'z': (8, F32)}, 12)
    return cloud_message(scan, STAMP, frame_id)


QUATERNION = (0.0, 0.6, 0.0, -0.8)


def pose(position: object = (1.0, -2.0, 3.0), quaternion: object = QUATERNION,
         frame_id: str = 'base') -> object:
    return new(POSE, header(STAMP, frame_id), new(
        'geometry_msgs/msg/Pose', new('geometry_msgs/msg/Point', *position),
        new('geometry_msgs/msg/Quaternion', *quaternion)))


def placed(child: str, quaternion: object = QUATERNION) -> object:
    return transform(STAMP, '/base', child, (1.0, -2.0, 3.0), quaternion)


@pytest.mark.parametrize('little_endian', [True, False])
@pytest.mark.parametrize('frame_id', ['', 'a', 'ab', 'abc', '/abcd', 'frame/é'])
def test_what_others_write_is_read(little_endian: bool, frame_id: str) -> None:
    scan = serialised(message(frame_id=frame_id), CLOUD, little_endian)
    line_profile = profile_from_cdr(scan, METRES)
    assert (line_profile.stamp, line_profile.frame_id) == (STAMP, frame_id.lstrip('/'))
    np.testing.assert_allclose(line_profile.points, expected(
        np.linspace(-0.02, 0.02, 50), np.full(50, 0.17)), rtol=1e-6)
    flange_pose = pose_from_cdr(serialised(pose(frame_id=frame_id), POSE, little_endian))
    both = new(TF, [placed(frame_id), placed('other')])
    transforms = transforms_from_cdr(serialised(both, TF, little_endian))
    assert [child for child, _ in transforms] == [frame_id.lstrip('/'), 'other']
    for read_pose in (flange_pose, *(link_pose for _, link_pose in transforms)):
        assert read_pose.stamp == STAMP
        np.testing.assert_array_equal(read_pose.translation, [1.0, -2.0, 3.0])
        np.testing.assert_allclose(read_pose.quaternion, [0.0, -0.6, 0.0, 0.8], rtol=1e-15)
    assert flange_pose.parent_frame == frame_id.lstrip('/')
    assert transforms[0][1].parent_frame == 'base'


def test_padding_to_a_word_is_read_and_more_is_damage() -> None:
    for little_endian in (True, False):
        whole = serialised(pose(), POSE, little_endian)
        assert pose_from_cdr(whole + bytes(3)).stamp == STAMP
        with pytest.raises(UnusableMessageError, match='damaged message'):
            pose_from_cdr(whole + bytes(8))


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize(('position', 'quaternion', 'reason'), [
    ((0.0, 0.0, 0.0), (0.0, 0.0, 0.5, 1.0), 'quaternion of length 1.118, expected 1'),
    ((0.0, 0.0, 0.0), (0.0, 0.0, np.nan, 1.0), 'not finite'),
    ((np.inf, -np.inf, 0.0), (0.0, 0.0, 0.0, 1.0), 'not finite'),
    ((0.0, 3e12, 0.0), (0.0, 0.0, 0.0, 1.0), 'the position reaches 3e.12 m')])
def test_malformed_poses_are_refused_with_a_reason(position, quaternion, reason):
    with pytest.raises(UnusableMessageError, match=reason):
        pose_from_cdr(serialised(pose(position, quaternion), POSE))


def test_an_invalid_transform_does_not_affect_the_others() -> None:
    invalid = placed('camera', (0.0, 0.0, 0.0, 0.0))
    transforms = transforms_from_cdr(serialised(new(TF, [invalid, placed('flange')]), TF))
    assert [child for child, _ in transforms] == ['flange']
    with pytest.raises(UnusableMessageError, match='TransformStamped .* quaternion of length 0'):
        transforms_from_cdr(serialised(new(TF, [invalid]), TF))


@given(st.lists(st.floats(), min_size=7, max_size=7))
def test_any_pose_is_unit_or_refused(values: list[float]) -> None:
    try:
        read_pose = pose_from_cdr(serialised(pose(values[:3], values[3:]), POSE))
    except UnusableMessageError:
        return
    assert np.isfinite(read_pose.translation).all()
    assert np.linalg.norm(read_pose.quaternion) == pytest.approx(1.0, abs=1e-12)
    assert read_pose.quaternion[3] >= 0


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=300), st.integers(0, 300), st.booleans())
def test_any_bytes_are_a_message_or_refused(junk: bytes, keep: int, known: bool) -> None:
    reader, messages = ProfileReader(METRES), [
        serialised(message()), serialised(pose(), POSE), serialised(new(TF, [placed('a')]), TF)]
    if known:
        reader.take(messages[0])
    for whole, read in zip(messages, (lambda d: reader.take(d).read(), pose_from_cdr,
                                      transforms_from_cdr), strict=True):
        for data in (whole[:keep] + junk + whole[keep + len(junk):], whole[:keep]):
            try:
                read(data)
            except UnusableMessageError as error:
                assert 'message not used: ' in str(error)


def test_the_points_of_messages_without_a_stamp_are_checked_from_time_to_time() -> None:
    reader = ProfileReader(METRES)
    good, in_mm = (serialised(cloud_message(cloud({'x': X, 'z': z}, XZ, 12), 0, 'laser'))
                   for z in (0.17 + X, 170.0 + X))
    reader.take(good)
    for _ in range(CHECK_COUNT - 1):
        reader.take(in_mm)
    for _ in range(2):  # and then each, until one is usable
        with pytest.raises(UnusableMessageError, match='set profile.unit to mm'):
            reader.take(in_mm)


# -- clouds


@pytest.mark.filterwarnings('error')
def test_signalling_nan_is_no_return() -> None:
    scan = cloud({'x': X, 'z': X}, XZ, 12)
    scan.data.view('<u4')[2::3] = 0x7f800001
    assert np.isnan(points(scan)).all()


@pytest.mark.parametrize('height', [1, 2])
def test_a_row_step_that_was_left_unset_is_worked_out(height: int) -> None:
    scan = cloud({'x': X, 'z': Z}, XZ, 12, height=height)
    scan.row_step = 0
    np.testing.assert_allclose(points(scan), expected(X, Z), rtol=1e-6)


@pytest.mark.parametrize(('changes', 'reason'), [
    *((change, 'points of .* bytes, in rows of .* do not fit into') for change in (
        {'data': np.zeros(71, np.uint8)}, {'width': 2**31}, {'point_step': 0},
        {'height': 2**32 - 1, 'row_step': 2**32 - 1},
        {'width': 2**32 - 1, 'height': 2**32 - 1, 'row_step': 2**32 - 1},
        {'height': 2, 'width': 3, 'row_step': 35}, {'point_step': 11, 'width': 2},
        {'fields': [field('x', 2**32 - 1), field('z', 8)]})),
    ({'fields': []}, r'no fields are named "x" .*\(fields: none\)'),
    ({'fields': [field('x', 0, 9), field('z', 8)]}, 'no fields are named "x"'),
    ({'fields': [field('x', 0, 7, 3), field('z', 8)]}, 'are named "x" and hold one number'),
    ({'fields': [field('x', 0), field('x', 4), field('z', 8)]}, '2 fields are named "x"')])
def test_malformed_clouds_are_refused_with_a_reason(changes: dict, reason: str) -> None:
    scan = cloud({'x': X, 'z': Z}, XZ, 12)
    vars(scan).update(changes)
    with pytest.raises(UnusableMessageError, match=reason):
        points(scan)


@pytest.mark.parametrize(('factor', 'unit', 'words'), [
    (1e3, 'm', 'reach 172 m: set profile.unit to mm'),
    (1e6, 'mm', '172 m, but profile.unit is m or mm'),
    (1.0, 'mm', 'larger than 0.172 mm: set profile.unit to m')])
def test_a_wrong_unit_is_named(factor: float, unit: str, words: str) -> None:
    scan = cloud({'x': X * factor, 'z': np.full(6, 0.172 * factor)}, XZ, 12)
    with pytest.raises(UnusableMessageError, match=words):
        points(scan, ProfileConfig(unit=unit))


@pytest.mark.parametrize('marker', [-99.999, -2147483648.0])
def test_ranges_of_one_value_far_away_are_no_returns(marker: float) -> None:
    z = np.where(np.arange(6) < 4, marker, 0.172)
    np.testing.assert_array_equal(
        np.isfinite(points(cloud({'x': X, 'z': z}, XZ, 12))[:, 1]), z > 0)


@pytest.mark.parametrize(('rows', 'count'), [
    ([np.nan, 0, 1e-3], 3), ([0, 0.5e-3, np.nan], 3), ([0, 0.1, 0.2], 1), ([np.nan, 0], 1)])
def test_rows_along_the_same_line_are_profiles(rows: list[float], count: int) -> None:
    x = np.concatenate([np.linspace(-0.02, 0.02, 12) + shift for shift in rows])
    batch = cloud({'x': x, 'z': np.full(len(x), 0.17)}, XZ, 12, height=len(rows))
    assert profile_count(batch, ProfileConfig()) == count


layouts = st.fixed_dictionaries({
    'datatypes': st.lists(st.sampled_from(sorted(DATATYPES)), min_size=3, max_size=3),
    'order': st.permutations(['x', 'z', 'intensity']),
    'gaps': st.lists(st.integers(0, 9), min_size=4, max_size=4),
    'height': st.integers(1, 4), 'width': st.integers(1, 20), 'row_padding': st.integers(0, 30),
    'bigendian': st.booleans(), 'seed': st.integers(0, 2**31)})


def values_of(datatype: int, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return n values that the datatype can hold, within the reach of a profiler in mm."""
    kind = np.dtype(DATATYPES[datatype])
    if kind.kind == 'f':
        values = rng.uniform(-500.0, 500.0, n).astype(kind)
        lost = rng.random(n) < 0.2
        return np.where(lost, rng.choice([np.nan, np.inf, -np.inf], n), values).astype(kind)
    limits = np.iinfo(kind)
    return rng.integers(max(limits.min, -900), min(limits.max, 900), n).astype(kind)


@given(layouts, st.sampled_from([('x', 'z'), ('-x', 'z'), ('z', '-x'), ('-z', '-x')]))
def test_clouds_of_any_layout_are_read_as_they_were_written(form, axes):
    rng = np.random.default_rng(form['seed'])
    n, position, layout, columns = form['height'] * form['width'], 0, {}, {}
    for name, datatype, gap in zip(form['order'], form['datatypes'], form['gaps'], strict=False):
        layout[name] = (position + gap, datatype)
        position += gap + np.dtype(DATATYPES[datatype]).itemsize
        columns[name] = values_of(datatype, n, rng)
    for name in 'xz':  # integers too small to be millimetres are another test's
        columns[name][0] = 100
    columns[axes[0][-1]].sort()  # other orders, and the origin itself, are other tests'
    columns[axes[1][-1]][columns[axes[1][-1]] == 0] = 1
    scan = cloud(columns, layout, position + form['gaps'][3], height=form['height'],
                 row_padding=form['row_padding'], bigendian=form['bigendian'])
    signed = [columns[a[-1]].astype(float) * (-1 if a[0] == '-' else 1) for a in axes]
    read_points = points(scan, ProfileConfig(unit='mm', axes=axes))
    np.testing.assert_allclose(read_points, expected(*signed) * 1e-3, rtol=1e-12)


sizes = st.one_of(st.integers(0, 40), st.integers(0, 2**32 - 1))
garbage_fields = st.builds(field, st.sampled_from(['x', 'y', 'z', '', 'X']), sizes,
                           st.integers(0, 255), sizes)


@given(fields=st.lists(garbage_fields, max_size=4), height=sizes, width=sizes, point_step=sizes,
       row_step=sizes, data=st.binary(max_size=300), bigendian=st.booleans(),
       unit=st.sampled_from(['m', 'mm']))
def test_garbage_in_a_cloud_is_refused_in_a_sentence(unit, bigendian, height, width, **content):
    scan = cloud({'x': X, 'z': Z}, XZ, 12)
    vars(scan).update(height=height, width=width, is_bigendian=bigendian, **content)
    try:
        read_points = points(scan, ProfileConfig(unit=unit))
    except UnusableMessageError as error:
        assert str(error).startswith('PointCloud2 message not used: ')
    else:
        assert read_points.shape == (height * width, 2)
        assert (np.isfinite(read_points).all(axis=1) | np.isnan(read_points).all(axis=1)).all()


# -- order, axes, lost points

LINE = np.linspace(-0.03, 0.03, 200)
EDGE = np.where(LINE < 0.004, 0.17 + 0.1 * LINE, 0.19)
NOISY = EDGE + 5e-5 * np.sin(9.7 * np.arange(200))
LOST = np.where((LINE > 0.004) & (LINE < 0.012), np.nan, EDGE)


def layered(x: np.ndarray, z: np.ndarray, y: np.ndarray | None = None, **options: int) -> object:
    return cloud({'x': x, 'y': 0 * x if y is None else y, 'z': z}, XYZ, 12, **options)


@pytest.mark.parametrize('order', [
    np.arange(200)[::-1], np.random.default_rng(1).permutation(200), np.roll(np.arange(200), 77),
    np.r_[0:200:2, 1:200:2], np.arange(200).reshape(4, 50)[::-1].ravel()])
@pytest.mark.parametrize('z', [EDGE, LOST])
def test_points_come_in_any_order(order: np.ndarray, z: np.ndarray) -> None:
    read_points = points(layered(LINE[order], z[order]))
    step = -1 if order[0] == 199 and order[1] == 198 else 1
    np.testing.assert_allclose(read_points[::step], expected(LINE, z), rtol=1e-6)


@pytest.mark.parametrize('far', [0.0, 5.0])
def test_what_lost_points_hold_does_not_change_the_order(far: float) -> None:
    lost = np.isnan(LOST)
    read_points = points(layered(np.where(lost, -far, LINE), LOST))
    np.testing.assert_allclose(read_points, expected(LINE, LOST), rtol=1e-6)


@pytest.mark.parametrize(('columns', 'axes', 'advice'), [
    ((NOISY, 0 * LINE, LINE), ('x', 'z'), r'follow each other along z, not along x: .*\[z, x]'),
    ((0 * LINE, LINE, EDGE), ('x', 'z'), r'their y spans 60.0 mm, their x nothing: .*\[y, z]'),
    ((LINE, EDGE, 0 * LINE), ('x', 'z'), r'their y spans 23.0 mm, their z nothing: .*\[x, y]'),
    ((LINE, 0.5 * LINE, EDGE), ('x', 'z'), 'spans 30.0 mm: let the driver publish single'),
    ((LINE, 0 * LINE, EDGE), ('-y', 'z'), r'their x spans 60.0 mm, their y nothing: .*\[x, z]')])
def test_wrong_axes_are_named(columns: tuple, axes: tuple[str, str], advice: str) -> None:
    x, y, z = columns
    with pytest.raises(UnusableMessageError, match=advice):
        points(layered(x + 0, z + 1e-12, y), ProfileConfig(axes=axes))


def test_what_lost_points_hold_does_not_matter() -> None:
    lost = np.isnan(LOST)
    empty = layered(LINE, LOST)
    vars(empty).update(width=0, fields=[], point_step=0, row_step=0, data=b'')
    assert points(empty).shape == (0, 2)
    for x, z, y in ((np.where(lost, 0, LINE), np.where(lost, 0, LOST), 0 * LINE),  # the origin
                    (LINE, LOST, np.where(lost, 7.0, 0.012))):
        line_profile = profile_from_cloud(layered(x, z, y), METRES)
        np.testing.assert_allclose(line_profile.points, expected(LINE, LOST), rtol=1e-6)
        assert line_profile.out_of_plane == pytest.approx(y[0])
    for none in (1e30, np.finfo(np.float32).max, -np.inf):
        half = np.where(np.arange(200) % 3 > 0, none, 0.2)
        assert np.isnan(points(layered(LINE, half))[:, 1]).sum() == 133
    millimetres = np.where(np.arange(200) % 3 == 0, -327.68, 200.0)
    millimetres[1] = 0.0
    config = ProfileConfig(unit='mm', invalid=(0.0, -327.68), axes=('x', '-z'))
    marked = np.isnan(points(layered(LINE * 1e3, millimetres), config)[:, 1])
    assert marked.sum() == 68 and marked[1] and marked[::3].all()


# -- drivers: each read with the settings that docs/sensors.md gives for it

PAGE = (ROOT / 'docs' / 'sensors.md').read_text(encoding='utf-8')
WIDE = np.linspace(-0.02, 0.02, 640)
FLAT = 0 * WIDE
DEPTH = 0.2 + np.where(WIDE > 0.004, 0.1 * WIDE, 0.03)  # m; left of the edge 30 mm deeper
HEIGHT = 0.2 - DEPTH


def marked(values: np.ndarray, mark: float) -> np.ndarray:
    return np.where(np.arange(640) // 20 == 5, mark, values)


# name of the section -> columns, layout and point_step of its driver's messages
MESSAGES: dict[str, tuple[dict[str, np.ndarray], dict[str, tuple[int, int]], int]] = {
    'scancontrol': ({'x': WIDE, 'y': FLAT, 'z': marked(DEPTH, np.inf), 'intensity': FLAT + 1},
                    {**XYZ, 'intensity': (16, F32)}, 32),
    'Gocator': ({'x': WIDE * 1e3, 'y': FLAT, 'z': marked(HEIGHT, np.nan) * 1e3}, XYZ, 12),
    'Mech-Mind': ({'x': WIDE, 'y': FLAT, 'z': marked(HEIGHT, np.nan), 'intensity': FLAT + 9},
                  {**XYZ, 'intensity': (12, U8)}, 16)}


@pytest.mark.parametrize('name', MESSAGES)
def test_the_edge_is_found_in_the_messages_of_a_driver(name: str, tmp_path: Path) -> None:
    section = PAGE.split(f'\n## {name}\n')[1].split('\n## ')[0]
    (tmp_path / 'sensor.yaml').write_text(
        re.findall(r'^```yaml\n(.*?)^```', section, flags=re.MULTILINE | re.DOTALL)[0])
    config = configs.load(tmp_path / 'sensor.yaml')
    columns, layout, step = MESSAGES[name]
    size = 1e-5 * (1e3 if config.profile.unit == 'mm' else 1.0)
    noise = size * np.random.default_rng(1).normal(size=640)
    noisy = {**columns, 'z': columns['z'] + noise}
    features = face_features(points(cloud(noisy, layout, step), config.profile), config)
    edges = [f.point[0] for f in features if isinstance(f, EdgePoint)]
    assert min(abs(x - 0.004) for x in edges) < 2e-4
    if name == 'Mech-Mind':  # which sends batches, stamped when they are complete
        batch = cloud({key: np.tile(v, 5) for key, v in columns.items()}, layout, step, height=5)
        assert (profile_count(batch, config.profile), config.profile.stamp) == (5, 'last')
