# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The markers show the samples where the answer puts them, and how sure it is."""
from __future__ import annotations

from threading import Lock
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from command import ROOT  # noqa: E402, I100
from handeye_ros import config as configs  # noqa: E402
from handeye_ros import pipeline, se3  # noqa: E402
from handeye_ros.bags.bag import read  # noqa: E402
from handeye_ros.node import markers as scene  # noqa: E402
from handeye_ros.node.arrivals import Latest  # noqa: E402
import numpy as np  # noqa: E402
from visualization_msgs.msg import Marker  # noqa: E402

pytestmark = pytest.mark.ros


@pytest.fixture(scope='module')
def plate() -> tuple[Any, Any, Any, Any]:
    """Return recording, samples, calibration and configuration of a plate."""
    config = configs.load(ROOT / 'config' / 'plate.yaml')
    recording = read(ROOT / 'bags' / 'plate', config)
    session = pipeline.gather(recording.profiles, recording.poses, config)
    calibration = pipeline.solve(session.samples, session.rejects, config, session.frame_id)
    residuals = {report.stamp: report.residual for report in calibration.samples}
    seen = [(o.number, o.sample, residuals[o.sample.stamp])
            for o in session.outcomes if o.sample]
    return recording, seen, calibration, config


def named(found: Any, name: str) -> list[Marker]:
    return [marker for marker in found.markers if marker.ns == name]


def places(marker: Marker) -> np.ndarray:
    return np.array([[p.x, p.y, p.z] for p in marker.points])


def test_without_an_answer_only_the_robot_is_shown(plate: Any) -> None:
    _, seen, _, config = plate
    found = scene.session_markers(seen, None, config)
    assert found.markers[0].action == Marker.DELETEALL
    assert {marker.ns for marker in found.markers[1:]} == {'flanges', 'numbers'}
    numbers = [str(number) for number, _, _ in seen]
    assert [marker.text for marker in named(found, 'numbers')] == numbers
    assert {marker.header.frame_id for marker in found.markers} == {'base'}


def test_the_samples_lie_on_the_edges_that_are_drawn(plate: Any) -> None:
    _, seen, calibration, config = plate
    found = scene.session_markers(seen, calibration, config)
    (samples,), edges = named(found, 'samples'), named(found, 'edges')
    assert len(edges) == 2 and len(samples.points) == len(seen) == len(samples.colors)
    for point in places(samples):
        distances = []
        for a, b in (places(edge) for edge in edges):
            along = (b - a) / np.linalg.norm(b - a)
            distances.append(np.linalg.norm(point - a - ((point - a) @ along) * along))
        assert min(distances) < 2e-4
    texts = [marker.text for marker in named(found, 'numbers at the target')]
    assert texts[0] == f'{seen[0][0]}: {seen[0][2] * 1e3:.3f} mm'
    assert len({(m.ns, m.id) for m in found.markers}) == len(found.markers)


def test_the_ellipsoid_is_the_covariance_enlarged_as_it_says(plate: Any) -> None:
    _, seen, calibration, config = plate
    found = scene.session_markers(seen, calibration, config)
    ellipsoid, text = named(found, 'uncertainty')
    factor = float(text.text.removeprefix('1 sigma x '))
    q = ellipsoid.pose.orientation
    R = se3.from_quaternion(np.zeros(3), np.array([q.x, q.y, q.z, q.w]))[:3, :3]
    scale = np.array([ellipsoid.scale.x, ellipsoid.scale.y, ellipsoid.scale.z]) / 2 / factor
    R_base_flange = seen[-1][1].T_base_flange[:3, :3]
    expected = R_base_flange @ calibration.covariance[:3, :3] @ R_base_flange.T
    np.testing.assert_allclose(R * scale ** 2 @ R.T, expected, rtol=1e-6, atol=1e-16)
    assert 0.008 < max(scale) * factor <= 0.02


def test_the_profile_of_now_lies_on_the_target(plate: Any) -> None:
    recording, seen, calibration, config = plate
    stop = seen[4][1]
    latest = Latest(Lock())
    latest.add(poses=[p for p in recording.poses if abs(p.stamp - stop.stamp) < 3e8])
    assert latest.current(config) is None
    latest.add([next(p for p in recording.profiles if p.stamp == stop.stamp)])
    current = latest.current(config)
    assert current is not None
    np.testing.assert_allclose(current.T_base_flange, stop.T_base_flange, atol=1e-5)
    found = scene.current_markers(current, calibration, config)
    assert {m.ns for m in found.markers[1:]} == {'profile', 'feature', 'sensor', 'uncertainty'}
    (edges,) = [m for m in named(found, 'feature') if m.type == Marker.SPHERE_LIST]
    session = scene.session_markers([seen[4]], calibration, config)
    np.testing.assert_allclose(places(edges), places(named(session, 'samples')[0]), atol=1e-3)
