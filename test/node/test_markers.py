# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The markers show the samples, and the profile of now, where the answer puts them."""
from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from handeye_ros.node.outputs import current_markers, session_markers  # noqa: E402, I100
from live_sessions import computed, feed, new, SPHERE  # noqa: E402
import numpy as np  # noqa: E402
from visualization_msgs.msg import Marker  # noqa: E402

pytestmark = pytest.mark.ros


def points(found: Any, name: str) -> np.ndarray:
    """Return the points of markers with a name."""
    return np.array([[p.x, p.y, p.z] for marker in found.markers if marker.ns == name
                     for p in marker.points])


def test_samples_and_the_profile_of_now_lie_on_the_target() -> None:
    live = new()
    middle = SPHERE.poses[len(SPHERE.poses) // 2].stamp
    items = [*SPHERE.poses, *SPHERE.profiles]
    feed(live, [item for item in items if item.stamp < middle])
    current = live.current()
    assert current
    feed(live, [item for item in items if item.stamp >= middle])
    samples = [(o.number, o.sample) for o in live.copied().outcomes if o.sample]
    before = session_markers(samples, None, SPHERE.config)
    assert before.markers[0].action == Marker.DELETEALL
    assert {marker.ns for marker in before.markers[1:]} == {'flanges', 'numbers'}
    assert [m.text for m in before.markers if m.text] == [str(number) for number, _ in samples]
    assert len(current_markers(current, None, SPHERE.config).markers) == 1
    computed(live)
    found = session_markers(samples, live.answer.calibration, SPHERE.config)
    now = current_markers(current, live.answer.calibration, SPHERE.config)
    assert {marker.header.frame_id for marker in [*found.markers, *now.markers]} == {'base'}
    assert len({(m.ns, m.id) for m in found.markers}) == len(found.markers)
    centre = np.array([live.answer.calibration.target['centre'][axis] for axis in 'xyz'])
    for shown in (points(found, 'what the answer comes from'), points(now, 'feature')):
        np.testing.assert_allclose(np.linalg.norm(shown - centre, axis=1), 0.04, atol=5e-4)
    assert len(points(now, 'profile')) >= len(points(now, 'feature')) > 10
