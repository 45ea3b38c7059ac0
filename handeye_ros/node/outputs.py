# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Publishers of the node: answer, samples, state, markers, diagnostics.

A latched topic keeps its last message for late subscribers. When the answer is withdrawn, its
publisher is created again, so that a late subscriber gets none; ~/status informs the others.
"""
from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Iterator
import json
import re
import threading
import time
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, TransformStamped
from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Arc, Calibration, EdgePoint, Sample
from handeye_ros.errors import INSTALL_TF2
from handeye_ros.evidence import count_of
from handeye_ros.node.arrivals import Arrivals
from handeye_ros.node.live import LiveSession
from handeye_ros.node.markers import current_markers, ends, session_markers, set_fields
from handeye_ros.node.state import (
    CURRENT,
    NONE,
    samples_message,
    State,
    state_of,
    status_message,
    taken,
    WITHDRAWN,
)
from handeye_ros.node.streams import TFMessage
from handeye_ros.results.scene import in_sensor
import numpy as np
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header, String
from visualization_msgs.msg import MarkerArray

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
UNWATCHED = PublisherEventCallbacks(use_default_callbacks=False)
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
PERIOD = 10.0  # s until a lasting warning is repeated


class Outputs:
    """The publishers; unchanged content is not published again."""

    def __init__(self, node: Node, live: LiveSession) -> None:
        """Advertise all topics."""
        self._node, self._live = node, live
        self._lock = threading.Lock()
        self._closed = False
        self._shown: Calibration | None = None
        self._published: dict[str, str] = {}
        self._texts = {name: node.create_publisher(String, f'~/{name}', LATCHED)
                       for name in ('samples', 'status', 'guidance')}
        self._markers = node.create_publisher(MarkerArray, '~/markers', LATCHED)
        self._current = node.create_publisher(MarkerArray, '~/current', 1)
        self._features = node.create_publisher(PointCloud2, '~/features', 10)
        self._diagnostics = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        if not TFMessage:
            node.get_logger().warning('tf2_msgs is not installed: the transform is published on '
                                      f'~/calibration only, not on /tf_static; {INSTALL_TF2}')
        self._advised: State = {}
        self._next_pose = self._latched(PoseStamped, '~/next_pose')
        self._advertise_answer()

    def _latched(self, kind: Any, name: str) -> Publisher:
        """
        Create a latched publisher that may be destroyed while an executor waits.

        It has no event callbacks: an executor that waits for these ends when they are destroyed.
        """
        return self._node.create_publisher(kind, name, LATCHED, event_callbacks=UNWATCHED)

    def _advertise_answer(self) -> None:
        self._calibration = self._latched(TransformStamped, '~/calibration')
        self._tf_static = TFMessage and self._latched(TFMessage, '/tf_static')

    def show(self) -> None:
        """Publish all changes."""
        with self._lock:
            if self._closed:
                return
            live, state = self._live, state_of(self._live)
            calibration = live.calibration
            changed = self._publish_text('samples', json.dumps(samples_message(state)))
            if calibration is not self._shown:
                self._show_answer(calibration)
                changed = True
            if changed:
                residuals = {sample['number']: sample['residual'] for sample in state['samples']}
                samples = [(outcome.number, outcome.sample, residuals.get(outcome.number))
                           for outcome in live.copied().outcomes if outcome.sample]
                self._markers.publish(session_markers(samples, calibration, live.framed))
            self._publish_text('status', json.dumps(status_message(state)))
            self._show_guidance(state['guidance'])

    def close(self) -> None:
        """
        Publish no further changes.

        A publisher that is created after the executor has ended would end the process.
        """
        with self._lock:
            self._closed = True

    def _publish_text(self, name: str, text: str) -> bool:
        """Publish a text if it has changed; return whether it has."""
        if self._published.get(name) == text:
            return False
        self._published[name] = text
        self._texts[name].publish(String(data=text))
        return True

    def _show_answer(self, calibration: Calibration | None) -> None:
        self._shown = calibration
        if calibration is None:
            for publisher in filter(None, (self._calibration, self._tf_static)):
                self._node.destroy_publisher(publisher)
            self._advertise_answer()
            return
        config = self._live.framed
        transform = transform_stamped(calibration, self._node.get_clock().now().to_msg())
        self._calibration.publish(transform)
        robot = (config.base_frame, config.robot_effector_frame)
        if self._tf_static and calibration.child_frame not in robot:
            self._tf_static.publish(TFMessage(transforms=[transform]))

    def _show_guidance(self, guidance: State) -> None:
        """Publish the guidance, and the next pose if there is one."""
        if guidance == self._advised:
            return
        self._advised = guidance
        self._publish_text('guidance', guidance['text'])
        if guidance['translation'] is None:
            self._node.destroy_publisher(self._next_pose)
            self._next_pose = self._latched(PoseStamped, '~/next_pose')
        else:
            self._next_pose.publish(pose_stamped(
                guidance['translation'], guidance['rotation'], self._live.framed.base_frame,
                self._node.get_clock().now().to_msg()))

    def show_current(self) -> None:
        """Publish the current profile with its features, if there is a subscriber."""
        if self._current.get_subscription_count():
            config = self._live.framed
            self._current.publish(current_markers(
                self._live.latest.current(config), self._live.calibration, config))

    def show_features(self, sample: Sample) -> None:
        """Publish the features of a new sample."""
        self._features.publish(_feature_cloud(sample, self._live.config,
                                              self._live.session.frame_id))

    def diagnose(self, state: State) -> None:
        """
        Publish the state on /diagnostics.

        Levels: ERROR if no usable message of a kind was ever received, or a published answer was
        withdrawn; WARN if the operator should check.
        """
        name = self._node.get_fully_qualified_name().lstrip('/')
        statuses = [DiagnosticStatus(
            name=f'{name}: {concern}', hardware_id=state['name'], level=level, message=message,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
            for concern, level, message, values in _concerns(state, self._live.arrivals)]
        header = Header(stamp=self._node.get_clock().now().to_msg())
        self._diagnostics.publish(DiagnosticArray(header=header, status=statuses))


def _concerns(state: State, arrivals: Arrivals
              ) -> Iterator[tuple[str, bytes, str, dict[str, object]]]:
    for stream in (state['profiles'], state['poses']):
        kind, count, trouble = stream['kind'], stream['count'], stream['trouble']
        level = OK if not trouble else WARN if count else ERROR
        yield f'{kind}s', level, trouble or f'{count_of(count, kind)} on {stream["topic"]}', {
            f'{kind}s': count, f'malformed {kind}s': stream['malformed'],
            f'lost {kind}s': stream['lost'],
            f'seconds since the last {kind}': f'{stream["age"]:.1f}',
            f'topic of the {kind}s': stream['topic']}
    session, attempt = state['session'], state['attempt']
    refused = [sample['text'] for sample in state['samples'] if not sample['taken']]
    if attempt and not attempt['accepted']:
        refused.append(attempt['text'])
    count = taken(state)
    yield 'session', WARN if session['trouble'] else OK, (
        session['trouble'] or session['working'] or count_of(count, 'sample')), {
        'samples': count, 'mode': session['mode'], 'folder': session['path'] or 'none yet',
        'robot': state['motion']['text'], 'dropped': '; '.join(session['notes']),
        'last attempt': attempt['text'] if attempt else 'none yet',
        'last refusal': refused[-1] if refused else '',
        'malformed messages': arrivals.malformed.total(),
        'last malformed': arrivals.last_malformed,
        'worst first': ', '.join(map(str, state['worst'])) or state['review']}
    answer = state['calibration']
    level = {CURRENT: OK, NONE: OK, WITHDRAWN: ERROR}.get(answer['state'], WARN)
    yield 'calibration', level, answer['text'], {
        'calibration': answer['text'] if answer['translation'] else 'none yet',
        'state': answer['state']}


class RepeatedWarnings:
    """Repeats a persistent warning every PERIOD; changed numbers do not make it new."""

    def __init__(self, log: Callable[[str], object]) -> None:
        """Start without warnings; log: receives the sentences."""
        self._log = log
        self._last_logged: dict[str, float] = {}

    def update(self, sentences: Iterable[str], now: float | None = None) -> None:
        """Log the sentences that are new or due again; forget all others."""
        now = time.monotonic() if now is None else now
        last_logged: dict[str, float] = {}
        for sentence in sentences:
            key = re.sub(r'[-+.\d]+', '#', sentence)
            last_logged[key] = self._last_logged.get(key, -PERIOD)
            if now - last_logged[key] >= PERIOD:
                self._log(sentence)
                last_logged[key] = now
        self._last_logged = last_logged


def transform_stamped(calibration: Calibration, stamp: Time) -> TransformStamped:
    """Return the answer as the pose of the sensor in its parent frame."""
    msg = TransformStamped(child_frame_id=calibration.child_frame)
    msg.header = Header(stamp=stamp, frame_id=calibration.parent_frame)
    T = calibration.T_flange_sensor
    set_fields(msg.transform.translation, 'xyz', T[:3, 3])
    set_fields(msg.transform.rotation, 'xyzw', se3.quaternion(T))
    return msg


def pose_stamped(translation: Iterable[float], rotation: Iterable[float], frame_id: str,
                 stamp: Time) -> PoseStamped:
    """Return a pose (x y z in m, quaternion x y z w) in a frame."""
    msg = PoseStamped(header=Header(stamp=stamp, frame_id=frame_id))
    set_fields(msg.pose.position, 'xyz', translation)
    set_fields(msg.pose.orientation, 'xyzw', rotation)
    return msg


def time_message(stamp: int) -> Time:
    """Return a stamp (ns) as a message."""
    sec, nanosec = divmod(stamp, 1_000_000_000)
    return Time(sec=sec, nanosec=nanosec)


def _feature_cloud(sample: Sample, config: Config, frame_id: str) -> PointCloud2:
    """Return edge points, points of arcs and ends of lines of a sample, in the sensor frame."""
    points = [f.point[None] for f in sample.features if isinstance(f, EdgePoint)]
    points += [f.points for f in sample.features if isinstance(f, Arc)]
    xyz = in_sensor(np.concatenate([*points, ends(sample.features)]), config)
    named = xyz.astype('<f4', order='C').view([(name, '<f4') for name in 'xyz'])[:, 0]
    return cloud(named, frame_id, sample.stamp)


def cloud(points: NDArray[Any], frame_id: str, stamp: int) -> PointCloud2:
    """Return a message of points (n,), an array with fields of type float32; stamp: ns."""
    return PointCloud2(
        header=Header(stamp=time_message(stamp), frame_id=frame_id), height=1,
        width=len(points), point_step=points.itemsize, row_step=points.nbytes, is_dense=True,
        fields=[PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
                for k, name in enumerate(points.dtype.names or ())],
        data=array('B', points.tobytes()))
