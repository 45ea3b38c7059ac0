# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Poses between two poses."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.data import Array, TimedPose
from handeye_ros.sampling.stream import interpolate
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from streams import pose, START


def random_walk(seed: int, count: int = 6) -> list[TimedPose]:
    rng = np.random.default_rng(seed)
    stamps = START + np.cumsum(rng.integers(1, 50, count)) * 1_000_000  # of milliseconds
    quaternions = rng.normal(size=4) + 0.3 * rng.normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
    return [TimedPose(int(s), rng.normal(size=3), q) for s, q in
            zip(stamps, quaternions, strict=True)]


def slerp(a: Array, b: Array, share: float) -> Array:
    """Return the great circle from quaternion a to b (Shoemake 1985), the short way."""
    b = b if a @ b >= 0 else -b
    angle = np.arccos(min(1.0, float(a @ b)))
    if angle < 1e-9:
        return a
    return (np.sin((1 - share) * angle) * a + np.sin(share * angle) * b) / np.sin(angle)


@given(st.integers(0, 1000), st.floats(0, 1))
def test_poses_between_are_linear_and_on_the_great_circle(seed: int, at: float) -> None:
    poses = random_walk(seed)
    stamp = poses[0].stamp + round(at * (poses[-1].stamp - poses[0].stamp))
    k = min(max(sum(p.stamp <= stamp for p in poses) - 1, 0), len(poses) - 2)
    a, b = poses[k], poses[k + 1]
    share = (stamp - a.stamp) / (b.stamp - a.stamp)
    translation = (1 - share) * a.translation + share * b.translation
    expected = se3.from_quaternion(translation, slerp(a.quaternion, b.quaternion, share))
    assert np.allclose(interpolate(poses, [stamp])[0], expected, atol=1e-6)


def test_stamps_of_this_century_keep_their_nanoseconds() -> None:
    a, b = pose(0.0), pose(1.0, x=1.0)
    at = [a.stamp + 1, a.stamp + 500_000_001]
    assert np.allclose(interpolate([a, b], at)[:, 0, 3], [1e-9, 0.500000001], atol=1e-15, rtol=0)
