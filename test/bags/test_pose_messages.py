"""Poses from messages: any is a unit quaternion and finite, or refused."""
from __future__ import annotations

from types import SimpleNamespace

from handeye_ros.bags.messages import pose_from_stamped, pose_from_transform
from handeye_ros.node.errors import MessageError
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from ros_clouds import pose


def test_pose():
    got = pose_from_stamped(pose((1.0, -2.0, 3.0), (0.0, 0.6, 0.0, -0.8)))
    assert (got.stamp, got.parent_frame) == (1_700_000_000_000_000_001, 'base')
    np.testing.assert_array_equal(got.translation, [1.0, -2.0, 3.0])
    np.testing.assert_allclose(got.quaternion, [0.0, -0.6, 0.0, 0.8], rtol=1e-15)


def test_pose_of_a_transform():
    stamped = pose((1.0, -2.0, 3.0), (0.0, 0.6, 0.0, -0.8))
    transform = SimpleNamespace(header=stamped.header, transform=SimpleNamespace(
        translation=stamped.pose.position, rotation=stamped.pose.orientation))
    got, same = pose_from_transform(transform), pose_from_stamped(stamped)
    np.testing.assert_array_equal(got.translation, same.translation)
    np.testing.assert_array_equal(got.quaternion, same.quaternion)


def test_slightly_rounded_quaternion_is_normalised():
    got = pose_from_stamped(pose(orientation=(0.0, 0.0, 0.70711, 0.70711)))
    assert np.linalg.norm(got.quaternion) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize(('position', 'orientation', 'reason'), [
    ((0, 0, 0), (0, 0, 0, 0), 'quaternion of length 0, expected 1'),
    ((0, 0, 0), (0, 0, 0.5, 1.0), 'quaternion of length 1.118, expected 1'),
    ((0, 0, 0), (1e200, 0, 0, 0), 'quaternion of length 1e'),
    ((0, 0, 0), (0, 0, float('nan'), 1), 'not finite'),
    ((0, float('inf'), 0), (0, 0, 0, 1), 'not finite'),
    ((0, 3e12, 0), (0, 0, 0, 1), 'the position reaches 3e.12 m'),
])
def test_malformed_poses(position, orientation, reason):
    with pytest.raises(MessageError, match=reason):
        pose_from_stamped(pose(position, orientation))


floats = st.floats(allow_nan=True, allow_infinity=True)


@given(st.tuples(floats, floats, floats), st.tuples(floats, floats, floats, floats))
def test_any_pose_is_unit_or_refused(position, orientation):
    try:
        got = pose_from_stamped(pose(position, orientation))
    except MessageError:
        return
    assert np.isfinite(got.translation).all()
    assert np.linalg.norm(got.quaternion) == pytest.approx(1.0, abs=1e-12)
    assert got.quaternion[3] >= 0
