# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the node publishes: its publishers, and the markers of its session."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
import json
import threading
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, PoseStamped, TransformStamped, Vector3
from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Calibration, has_return, StopSnapshot
from handeye_ros.errors import INSTALL_TF2
from handeye_ros.frames import mount_poses, target_frame
from handeye_ros.node.live import LiveSession
from handeye_ros.node.ros_messages import (
    cloud,
    header_of,
    LATCHED_QOS,
    pose_stamped,
    transform_of,
    xyz_message,
)
from handeye_ros.node.state import (
    Attempt,
    CURRENT,
    NONE,
    sample_count,
    samples_message,
    State,
    state_of,
    status_message,
    WITHDRAWN,
)
from handeye_ros.node.streams import TFMessage
from handeye_ros.results.scene import (
    feature_points,
    FLANGE_COLOUR,
    LASER_COLOUR,
    scene,
    SEEN_COLOUR,
    sensor_points,
)
from handeye_ros.sampling.stops import Stop
from handeye_ros.words import count_of
import numpy as np
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import ColorRGBA, String
from visualization_msgs.msg import Marker, MarkerArray

# An executor that waits for the events of a publisher ends when this is destroyed.
NO_CALLBACKS = PublisherEventCallbacks(use_default_callbacks=False)
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
METRES_PER_WIDTH = 1e-3  # m for each unit of width of the scene, of a text of its height


class Outputs:
    """The publishers; unchanged content is not published again."""

    def __init__(self, node: Node, live: LiveSession) -> None:
        """Advertise the topics; those of the session with the first changes."""
        self._node, self._live = node, live
        self._lock, self._closed = threading.Lock(), False
        self._logged_attempt: Attempt | None = None
        self._latched: dict[str, tuple[Any, Any]] = {}  # publisher and content, by topic
        if not TFMessage:
            node.get_logger().warning('tf2_msgs is not installed: the transform is published on '
                                      f'~/calibration only, not on /tf_static; {INSTALL_TF2}')
        self._current = node.create_publisher(MarkerArray, '~/current', 1)
        self._features = node.create_publisher(PointCloud2, '~/features', 10)
        self._diagnostics = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def _now(self) -> int:
        """Return the time of now (ns)."""
        return int(self._node.get_clock().now().nanoseconds)

    @property
    def _config(self) -> Config:
        return self._live.session.config_with_base_frame(self._live.config)

    def close(self) -> None:
        """
        Publish no further changes.

        A publisher that is created after the executor has ended would end the process.
        """
        with self._lock:
            self._closed = True

    def publish_changes(self) -> None:
        """Log a new attempt to take a sample, and publish all changes."""
        with self._lock:
            if self._closed:
                return
            live, config, stamp = self._live, self._config, self._now()
            state, calibration = state_of(live), live.solver.calibration
            self._publish_attempt(live.attempt)
            samples, status = json.dumps(samples_message(state)), json.dumps(status_message(state))
            guidance = state['guidance']
            transform = calibration and transform_of(calibration, stamp)
            place = guidance['translation'], guidance['rotation'], config.base_frame
            for name, text in (('~/samples', samples), ('~/status', status),
                               ('~/guidance', guidance['text'])):
                self._latch(name, String, text, partial(String, data=text))
            self._latch('~/next_pose', PoseStamped, place if guidance['translation'] else None,
                        lambda: pose_stamped(*place, stamp))
            self._latch('~/calibration', TransformStamped, calibration, lambda: transform)
            if TFMessage:
                self._latch('/tf_static', TFMessage, calibration,
                            lambda: TFMessage(transforms=[transform]))
            self._latch('~/markers', MarkerArray, (samples, calibration), lambda: session_markers(
                live.session_copy().stops, calibration, config))

    def _latch(self, name: str, message_type: Any, content: Any, message_of: Callable[[], Any]
               ) -> None:
        """
        Publish the message of a content that is not the last one, for late subscribers too.

        None withdraws the last message: a new publisher gives a late subscriber none.
        """
        publisher, last_content = self._latched.get(name, (None, None))
        if content is None and last_content is not None:
            self._node.destroy_publisher(publisher)
            publisher = None
        publisher = publisher or self._node.create_publisher(
            message_type, name, LATCHED_QOS, event_callbacks=NO_CALLBACKS)
        if content != last_content and content is not None:
            publisher.publish(message_of())
        self._latched[name] = publisher, content

    def _publish_attempt(self, attempt: Attempt | None) -> None:
        """Log an attempt once, and publish the features of its sample in the sensor frame."""
        if attempt is None or attempt is self._logged_attempt:
            return
        sample, log = attempt.stop.sample, self._node.get_logger()
        self._logged_attempt = attempt
        if sample is None:
            log.warning(attempt.text)
        else:
            log.info(attempt.text)
            xyz = sensor_points(feature_points(sample.features), self._live.config)
            points = xyz.astype('<f4', order='C').view([(name, '<f4') for name in 'xyz'])[:, 0]
            self._features.publish(cloud(points, self._live.session.frame_id, sample.stamp))

    def publish_current(self) -> None:
        """Publish the current profile with its features, if there is a subscriber."""
        if self._current.get_subscription_count():
            self._current.publish(current_markers(
                self._live.current_snapshot(), self._live.solver.calibration, self._config))

    def publish_diagnostics(self, state: State) -> None:
        """Publish the state on /diagnostics."""
        name = self._node.get_fully_qualified_name().lstrip('/')
        self._diagnostics.publish(DiagnosticArray(header=header_of(self._now(), ''), status=[
            DiagnosticStatus(
                name=f'{name}: {part}', hardware_id=state['name'], level=level, message=message,
                values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
            for part, level, message, values in _statuses(state)]))


def _statuses(state: State) -> Iterator[tuple[str, bytes, str, dict[str, object]]]:
    """
    Yield name, level, message and values of each status of /diagnostics.

    Levels: ERROR if no usable message of a kind was ever received, or a published answer was
    withdrawn; WARN if the operator should check.
    """
    streams = state['profiles'], state['poses']
    for stream in streams:
        kind, count, trouble = stream['kind'], stream['count'], stream['trouble']
        yield f'{kind}s', OK if not trouble else WARN if count else ERROR, (
            trouble or f'{count_of(count, kind)} on {stream["topic"]}'), {
            f'{kind}s': count, f'malformed {kind}s': stream['malformed'],
            f'lost {kind}s': stream['lost'],
            f'seconds since the last {kind}': f'{stream["age"]:.1f}',
            f'topic of the {kind}s': stream['topic']}
    session, attempt, count = state['session'], state['attempt'], sample_count(state)
    yield 'session', WARN if session['trouble'] else OK, (
        session['trouble'] or session['working'] or count_of(count, 'sample')), {
        'samples': count, 'mode': session['mode'], 'folder': session['path'] or 'none yet',
        'robot': state['motion']['text'], 'warnings': '; '.join(session['warnings']),
        'last attempt': attempt['text'] if attempt else 'none yet',
        'malformed messages': sum(stream['malformed'] for stream in streams),
        'last malformed': '; '.join(filter(None, (stream['reason'] for stream in streams)))}
    status = state['calibration']
    level = {CURRENT: OK, NONE: OK, WITHDRAWN: ERROR}.get(status['state'], WARN)
    yield 'calibration', level, status['text'], {'state': status['state']}


def session_markers(stops: Iterable[Stop], calibration: Calibration | None, config: Config
                    ) -> MarkerArray:
    """Return the flanges of samples with their numbers and, with an answer, its scene."""
    used = {each.stamp: each.used for each in calibration.samples} if calibration else {}
    snapshots = [
        StopSnapshot(stop.number, sample.stamp, mount_poses(sample.T_base_flange, config),
                     np.empty((0, 2)), sample.features, '' if sample.is_used(used) else 'unused')
        for stop in stops if (sample := stop.sample)]
    parts: list[dict[str, Any]] = [
        {'name': 'numbers', 'color': FLANGE_COLOUR, 'width': 12.0, 'text': str(snapshot.number),
         'points': [snapshot.T_fixed_mount[:3, 3]]} for snapshot in snapshots]
    if snapshots:
        parts.append({'name': 'flanges', 'color': FLANGE_COLOUR, 'width': 6.0,
                      'points': [snapshot.T_fixed_mount[:3, 3] for snapshot in snapshots]})
    if calibration:
        parts += scene(calibration, snapshots, config)['parts']
    return _markers(parts, config)


def current_markers(current: StopSnapshot | None, calibration: Calibration | None, config: Config
                    ) -> MarkerArray:
    """Return the current profile and its features, placed by the answer."""
    if current is None or calibration is None:
        return _markers([], config)
    T_fixed_sensor = current.T_fixed_mount @ calibration.T_flange_sensor
    points = current.points[has_return(current.points)]
    return _markers([{'name': name, 'color': color, 'width': width,
                      'points': se3.apply(T_fixed_sensor, sensor_points(plane, config))}
                     for name, color, width, plane in (
                         ('profile', LASER_COLOUR, 1.5, points),
                         ('feature', SEEN_COLOUR, 6.0, feature_points(current.features)))
                     if len(plane)],
                    config)


def _markers(parts: Iterable[Mapping[str, Any]], config: Config) -> MarkerArray:
    """Return the parts of a scene (results/scene.py), or texts, in place of all before."""
    markers = [Marker(action=Marker.DELETEALL)]
    for part in parts:
        red, green, blue = (int(part['color'][k:k + 2], 16) / 255 for k in (1, 3, 5))
        points = [xyz_message(Point, point) for point in part.get('line', part.get('points'))]
        marker = Marker(ns=part['name'], color=ColorRGBA(r=red, g=green, b=blue, a=1.0),
                        scale=xyz_message(Vector3, 3 * [METRES_PER_WIDTH * part['width']]))
        if 'text' in part:
            marker.type, marker.text = Marker.TEXT_VIEW_FACING, part['text']
            marker.pose.position, = points
        else:
            marker.type = Marker.LINE_STRIP if 'line' in part else Marker.POINTS
            marker.points = points
        markers.append(marker)
    for number, marker in enumerate(markers):
        marker.header.frame_id, marker.id = target_frame(config), number
    return MarkerArray(markers=markers)
