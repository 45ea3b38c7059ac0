"""The order of the points of a cloud, several lines in it, and axes that are others."""
from __future__ import annotations

from handeye_ros.bags.messages import profile_from_cloud
from handeye_ros.config import ProfileConfig
from handeye_ros.node.errors import MessageError
import numpy as np
import pytest
from ros_clouds import cloud, expected, METRES, points

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
    with pytest.raises(MessageError, match=advice):
        points(layered(x + 0, z + 1e-12, y), ProfileConfig(axes=axes))


def test_a_surface_of_many_profiles_is_refused():
    y = np.repeat(np.arange(10) * 0.001, 200)
    with pytest.raises(MessageError, match='their y spans 9.0 mm; a line profiler measures in'):
        points(layered(np.tile(LINE, 10), np.tile(EDGE, 10), y, height=10))


def test_a_third_coordinate_that_is_the_same_for_all_is_kept():
    profile = profile_from_cloud(layered(LINE, LOST, 0 * LINE + 0.012), METRES)
    assert profile.beside == pytest.approx(0.012)
    np.testing.assert_allclose(profile.points, expected(LINE, LOST), rtol=1e-6)


def test_the_origin_itself_is_no_return():
    lost = np.isnan(LOST)
    x, z = np.where(lost, 0, LINE), np.where(lost, 0, LOST)
    np.testing.assert_allclose(points(layered(x, z)), expected(LINE, LOST), rtol=1e-6)


def test_what_a_third_axis_holds_for_lost_points_does_not_matter():
    y = np.where(np.isnan(LOST), 7.0, 0.0)
    np.testing.assert_allclose(points(layered(LINE, LOST, y)), expected(LINE, LOST), rtol=1e-6)
