# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Profiles from clouds: the layouts of real drivers and of none, any order of the points."""
from __future__ import annotations

from types import SimpleNamespace

from handeye_ros.bags.messages import DATATYPES
from handeye_ros.config import ProfileConfig
from handeye_ros.errors import UnusableMessageError
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from ros_clouds import cloud, expected, field, header, points, profile

X = np.array([-0.02, -0.01, 0.0, 0.01, 0.02, 0.03])
Z = np.array([0.171, 0.172, np.nan, 0.174, np.inf, -np.inf])
XZ = {'x': (0, 7), 'z': (8, 7)}


@pytest.mark.filterwarnings('error')
def test_signalling_nan_is_no_return():
    msg = cloud({'x': X, 'z': X}, XZ, 12)
    msg.data.view('<u4')[2::3] = 0x7f800001
    assert np.isnan(points(msg)).all()


@pytest.mark.parametrize('height', [1, 2])
def test_a_row_step_that_was_left_unset(height):
    msg = cloud({'x': X, 'z': Z}, XZ, 12, height=height)
    msg.row_step = 0
    np.testing.assert_allclose(points(msg), expected(X, Z), rtol=1e-6)


@pytest.mark.parametrize(('changes', 'reason'), [
    *((change, 'points of .* bytes, in rows of .* do not fit into') for change in (
        {'data': np.zeros(71, np.uint8)}, {'width': 2**31},
        {'height': 2**32 - 1, 'row_step': 2**32 - 1},
        {'width': 2**32 - 1, 'height': 2**32 - 1, 'row_step': 2**32 - 1},
        {'height': 2, 'width': 3, 'row_step': 35}, {'point_step': 0},
        {'point_step': 11, 'width': 2}, {'fields': [field('x', 2**32 - 1), field('z', 8)]})),
    ({'fields': []}, r'no fields are named "x" \(fields: none\)'),
    ({'fields': [field('x', 0, 9), field('z', 8)]}, 'has datatype 9 and 1 values'),
    ({'fields': [field('x', 0, 0), field('z', 8)]}, 'has datatype 0 and 1 values'),
    ({'fields': [field('x', 0, 7, 3), field('z', 8)]}, 'datatype 7 and 3 values for each point'),
    ({'fields': [field('x', 0), field('x', 4), field('z', 8)]}, '2 fields are named "x"'),
])
def test_malformed_clouds(changes, reason):
    msg = cloud({'x': X, 'z': Z}, XZ, 12)
    vars(msg).update(changes)
    with pytest.raises(UnusableMessageError, match=reason):
        points(msg)


@pytest.mark.parametrize(('factor', 'unit', 'words'), [
    (1e3, 'm', 'reach 172 m: set profile.unit to mm'),
    (1e6, 'mm', '172 m, but profile.unit is m or mm'),
    (1.0, 'mm', 'larger than 0.172 mm: set profile.unit to m')])
def test_a_wrong_unit_is_named(factor, unit, words):
    msg = cloud({'x': X * factor, 'z': np.full(6, 0.172 * factor)}, XZ, 12)
    with pytest.raises(UnusableMessageError, match=words):
        points(msg, ProfileConfig(unit=unit))


layouts = st.fixed_dictionaries({
    'datatypes': st.lists(st.sampled_from(sorted(DATATYPES)), min_size=3, max_size=3),
    'order': st.permutations(['x', 'z', 'intensity']),
    'gaps': st.lists(st.integers(0, 9), min_size=4, max_size=4),
    'height': st.integers(1, 4),
    'width': st.integers(1, 20),
    'row_padding': st.integers(0, 30),
    'bigendian': st.booleans(),
    'seed': st.integers(0, 2**31),
})


def values_of(datatype, n, rng):
    """Return n values that the datatype can hold, within the reach of a profiler in mm."""
    kind = np.dtype(DATATYPES[datatype])
    if kind.kind == 'f':
        values = rng.uniform(-500.0, 500.0, n).astype(kind)
        lost = rng.random(n) < 0.2
        return np.where(lost, rng.choice([np.nan, np.inf, -np.inf], n), values).astype(kind)
    limits = np.iinfo(kind)
    return rng.integers(max(limits.min, -900), min(limits.max, 900), n).astype(kind)


@given(layouts, st.sampled_from([('x', 'z'), ('-x', 'z'), ('z', '-x'), ('-z', '-x')]))
def test_any_layout_round_trips(what, axes):
    rng = np.random.default_rng(what['seed'])
    n, position, layout, columns = what['height'] * what['width'], 0, {}, {}
    for name, datatype, gap in zip(what['order'], what['datatypes'], what['gaps'], strict=False):
        layout[name] = (position + gap, datatype)
        position += gap + np.dtype(DATATYPES[datatype]).itemsize
        columns[name] = values_of(datatype, n, rng)
    for name in 'xz':  # integers too small to be millimetres are another test's
        columns[name][0] = 100
    columns[axes[0][-1]].sort()  # other orders, and the origin itself, are other tests'
    columns[axes[1][-1]][columns[axes[1][-1]] == 0] = 1
    msg = cloud(columns, layout, position + what['gaps'][3], height=what['height'],
                row_padding=what['row_padding'], bigendian=what['bigendian'])
    signed = [columns[a[-1]].astype(float) * (-1 if a[0] == '-' else 1) for a in axes]
    got = points(msg, ProfileConfig(unit='mm', axes=axes))
    np.testing.assert_allclose(got, expected(*signed) * 1e-3, rtol=1e-12)


sizes = st.one_of(st.integers(0, 40), st.integers(0, 2**32 - 1))
garbage_fields = st.builds(field, st.sampled_from(['x', 'y', 'z', '', 'X']), sizes,
                           st.integers(0, 255), sizes)


@given(fields=st.lists(garbage_fields, max_size=4), height=sizes, width=sizes, point_step=sizes,
       row_step=sizes, data=st.binary(max_size=300), bigendian=st.booleans(),
       unit=st.sampled_from(['m', 'mm']))
def test_garbage_raises_message_error_and_nothing_else(fields, height, width, point_step,
                                                       row_step, data, bigendian, unit):
    msg = SimpleNamespace(header=header(), fields=fields, height=height, width=width,
                          point_step=point_step, row_step=row_step, data=data,
                          is_bigendian=bigendian, is_dense=False)
    try:
        got = points(msg, ProfileConfig(unit=unit))
    except UnusableMessageError as error:
        assert str(error).startswith('PointCloud2 message not used: ')
    else:
        assert got.shape == (height * width, 2)
        assert (np.isfinite(got).all(axis=1) | np.isnan(got).all(axis=1)).all()


LINE = np.linspace(-0.03, 0.03, 200)
EDGE = np.where(LINE < 0.004, 0.17 + 0.1 * LINE, 0.19)
NOISY = EDGE + 5e-5 * np.sin(9.7 * np.arange(200))
LOST = np.where((LINE > 0.004) & (LINE < 0.012), np.nan, EDGE)
ORDERS = {
    'backwards': np.arange(200)[::-1],
    'shuffled': np.random.default_rng(1).permutation(200),
    'a ring that starts in the middle': np.roll(np.arange(200), 77),
    'even columns, then odd ones': np.r_[0:200:2, 1:200:2],
    'blocks': np.arange(200).reshape(4, 50)[::-1].ravel(),
}


def layered(x, z, y=None, **options):
    layout = {'x': (0, 7), 'y': (4, 7), 'z': (8, 7)}
    return cloud({'x': x, 'y': 0 * x if y is None else y, 'z': z}, layout, 12, **options)


@pytest.mark.parametrize('order', ORDERS)
@pytest.mark.parametrize('z', [EDGE, LOST], ids=['all returns', 'some lost'])
def test_points_come_in_any_order(order, z):
    got = points(layered(LINE[ORDERS[order]], z[ORDERS[order]]))
    want = expected(LINE, z)
    np.testing.assert_allclose(got[::-1] if order == 'backwards' else got, want, rtol=1e-6)


def test_lost_points_without_a_place_leave_the_others_in_order():
    order = ORDERS['shuffled']
    lost = np.isnan(LOST[order])
    got = points(layered(np.where(lost, np.nan, LINE[order]), LOST[order]))
    np.testing.assert_allclose(got, expected(LINE, LOST)[~np.isnan(LOST)], rtol=1e-6)


def test_columns_that_run_back_behind_a_step_stay_as_the_sensor_has_them():
    x = LINE.copy()
    x[110:] -= 0.004  # rays that fan out hit what is behind the step further inside
    np.testing.assert_allclose(points(layered(x, EDGE)), expected(x, EDGE), rtol=1e-6)


@pytest.mark.parametrize('height', [2, 5])
def test_several_profiles_in_one_organised_cloud_are_one(height):
    rng = np.random.default_rng(3)
    z = EDGE + rng.normal(0, 3e-5, (height, 200))
    z[:, 20:30] = np.nan
    z[0, 40] = np.nan
    got = points(layered(np.tile(LINE, height), z.ravel(), height=height))
    want = np.nanmean(z[:, [*range(20), *range(30, 200)]], axis=0)
    np.testing.assert_allclose(got[~np.isnan(got[:, 1]), 1], want, rtol=1e-6)
    assert len(got) == 200 and np.isnan(got[20:30]).all()


@pytest.mark.parametrize(('columns', 'axes', 'advice'), [
    ((NOISY, 0 * LINE, LINE), ('x', 'z'), r'follow each other along z, not along x: .*\[z, x]'),
    ((0 * LINE, LINE, EDGE), ('x', 'z'), r'their y spans 60.0 mm, their x nothing: .*\[y, z]'),
    ((LINE, EDGE, 0 * LINE), ('x', 'z'), r'their y spans 23.0 mm, their z nothing: .*\[x, y]'),
    ((LINE, 0.5 * LINE, EDGE), ('x', 'z'), 'spans 30.0 mm; a line profiler measures in one'),
    ((LINE, 0 * LINE, EDGE), ('-y', 'z'), r'their x spans 60.0 mm, their y nothing: .*\[x, z]'),
])
def test_wrong_axes_are_named(columns, axes, advice):
    x, y, z = columns
    with pytest.raises(UnusableMessageError, match=advice):
        points(layered(x + 0, z + 1e-12, y), ProfileConfig(axes=axes))


def test_what_lost_points_hold_does_not_matter():
    lost = np.isnan(LOST)
    empty = SimpleNamespace(header=header(), height=1, width=0, fields=[], is_bigendian=False,
                            point_step=0, row_step=0, data=b'', is_dense=True)
    assert points(empty).shape == (0, 2)
    for x, z, y in ((np.where(lost, 0, LINE), np.where(lost, 0, LOST), 0 * LINE),  # the origin
                    (LINE, LOST, np.where(lost, 7.0, 0.012))):
        got = profile(layered(x, z, y))
        np.testing.assert_allclose(got.points, expected(LINE, LOST), rtol=1e-6)
        assert got.beside == pytest.approx(y[0])
    surface = layered(np.tile(LINE, 10), np.tile(EDGE, 10), np.repeat(np.arange(10), 200) * 1e-3,
                      height=10)
    with pytest.raises(UnusableMessageError, match='spans 9.0 mm; a line profiler measures'):
        points(surface)
