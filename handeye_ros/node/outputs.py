# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What goes out: the publishers of the node, and the messages that they and other executables send.

A latched topic keeps its last message for late subscribers. When the answer is withdrawn, its
publisher is created again, so that a late subscriber gets none; ~/status informs the others.
"""
from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator, Sequence
import json
import threading
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, PoseStamped, TransformStamped
from handeye_ros import se3
from handeye_ros.agreement import count_of
from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration, Sample
from handeye_ros.errors import INSTALL_TF2
from handeye_ros.frames import in_mount, target_frame
from handeye_ros.node.live import Current, LiveSession
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
from handeye_ros.results.evidence import in_plane, StopSnapshot
from handeye_ros.results.scene import FLANGE, in_sensor, LASER, scene, SEEN
import numpy as np
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header, String
from visualization_msgs.msg import Marker, MarkerArray

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# An executor that waits for the events of a publisher ends when this is destroyed.
UNWATCHED = PublisherEventCallbacks(use_default_callbacks=False)
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
DRAWN = 1e-3  # m for each unit of width of the scene
LETTER = 0.012  # m


class Outputs:
    """The publishers; unchanged content is not published again."""

    def __init__(self, node: Node, live: LiveSession) -> None:
        """Advertise all topics."""
        self._node, self._live = node, live
        self._lock, self.closed = threading.Lock(), False
        self._shown: Calibration | None = None
        self._published: dict[str, Any] = {}
        self._texts = {name: node.create_publisher(String, f'~/{name}', LATCHED)
                       for name in ('samples', 'status', 'guidance')}
        self._markers = node.create_publisher(MarkerArray, '~/markers', LATCHED)
        self._current = node.create_publisher(MarkerArray, '~/current', 1)
        self._features = node.create_publisher(PointCloud2, '~/features', 10)
        self._diagnostics = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        if not TFMessage:
            node.get_logger().warning('tf2_msgs is not installed: the transform is published on '
                                      f'~/calibration only, not on /tf_static; {INSTALL_TF2}')
        self._next_pose = self._latched(PoseStamped, '~/next_pose')
        self._advertise_answer()

    def _latched(self, kind: Any, name: str) -> Publisher:
        """Create a latched publisher that may be destroyed while an executor waits."""
        return self._node.create_publisher(kind, name, LATCHED, event_callbacks=UNWATCHED)

    def _advertise_answer(self) -> None:
        self._calibration = self._latched(TransformStamped, '~/calibration')
        self._tf_static = TFMessage and self._latched(TFMessage, '/tf_static')

    def _now(self) -> Time:
        return self._node.get_clock().now().to_msg()

    def show(self) -> None:
        """Publish all changes."""
        with self._lock:
            if self.closed:
                return
            live, state = self._live, state_of(self._live)
            calibration = live.calibration
            changed = self._publish_text('samples', json.dumps(samples_message(state)))
            if calibration is not self._shown:
                self._show_answer(calibration)
            if changed or calibration is not self._shown:
                samples = [(o.number, o.sample) for o in live.copied().outcomes if o.sample]
                self._markers.publish(session_markers(samples, calibration, live.framed))
            self._shown = calibration
            self._publish_text('status', json.dumps(status_message(state)))
            self._publish_text('guidance', state['guidance']['text'])
            self._show_next(state['guidance'])

    def close(self) -> None:
        """
        Publish no further changes.

        A publisher that is created after the executor has ended would end the process.
        """
        with self._lock:
            self.closed = True

    def _is_new(self, name: str, content: Any) -> bool:
        """Return whether a content differs from the last one of this name."""
        before, self._published[name] = self._published.get(name), content
        return bool(before != content)

    def _publish_text(self, name: str, text: str) -> bool:
        """Publish a text if it has changed; return whether it has."""
        new = self._is_new(name, text)
        if new:
            self._texts[name].publish(String(data=text))
        return new

    def _show_answer(self, calibration: Calibration | None) -> None:
        if calibration is None:
            for publisher in filter(None, (self._calibration, self._tf_static)):
                self._node.destroy_publisher(publisher)
            self._advertise_answer()
            return
        config = self._live.framed
        transform = transform_of(calibration, self._now())
        self._calibration.publish(transform)
        robot = (config.base_frame, config.robot_effector_frame)
        if self._tf_static and calibration.child_frame not in robot:
            self._tf_static.publish(TFMessage(transforms=[transform]))

    def _show_next(self, guidance: State) -> None:
        """Publish the next pose if there is one."""
        place = guidance['translation'], guidance['rotation']
        if not self._is_new('next_pose', place):
            return
        if guidance['translation'] is None:
            self._node.destroy_publisher(self._next_pose)
            self._next_pose = self._latched(PoseStamped, '~/next_pose')
        else:
            self._next_pose.publish(pose_stamped(*place, self._live.framed.base_frame,
                                                 self._now()))

    def show_current(self) -> None:
        """Publish the current profile with its features, if there is a subscriber."""
        if self._current.get_subscription_count():
            live = self._live
            self._current.publish(current_markers(live.current(), live.calibration, live.framed))

    def show_features(self, sample: Sample) -> None:
        """Publish the features of a new sample, in the sensor frame."""
        xyz = in_sensor(in_plane(sample.features), self._live.config)
        points = xyz.astype('<f4', order='C').view([(name, '<f4') for name in 'xyz'])[:, 0]
        self._features.publish(cloud(points, self._live.session.frame_id, sample.stamp))

    def diagnose(self, state: State) -> None:
        """
        Publish the state on /diagnostics.

        Levels: ERROR if no usable message of a kind was ever received, or a published answer was
        withdrawn; WARN if the operator should check.
        """
        name = self._node.get_fully_qualified_name().lstrip('/')
        self._diagnostics.publish(DiagnosticArray(header=Header(stamp=self._now()), status=[
            DiagnosticStatus(
                name=f'{name}: {concern}', hardware_id=state['name'], level=level, message=text,
                values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
            for concern, level, text, values in self._concerns(state)]))

    def _concerns(self, state: State) -> Iterator[tuple[str, bytes, str, dict[str, object]]]:
        for stream in (state['profiles'], state['poses']):
            kind, count, trouble = stream['kind'], stream['count'], stream['trouble']
            level = OK if not trouble else WARN if count else ERROR
            yield f'{kind}s', level, trouble or f'{count_of(count, kind)} on {stream["topic"]}', {
                f'{kind}s': count, f'malformed {kind}s': stream['malformed'],
                f'lost {kind}s': stream['lost'],
                f'seconds since the last {kind}': f'{stream["age"]:.1f}',
                f'topic of the {kind}s': stream['topic']}
        session, attempt = state['session'], state['attempt']
        messages = self._live.messages.values()
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
            'malformed messages': sum(one.malformed for one in messages),
            'last malformed': '; '.join(one.reason for one in messages if one.reason),
            'worst first': ', '.join(map(str, state['worst'])) or state['review']}
        answer = state['calibration']
        level = {CURRENT: OK, NONE: OK, WITHDRAWN: ERROR}.get(answer['state'], WARN)
        yield 'calibration', level, answer['text'], {
            'calibration': answer['text'] if answer['translation'] else 'none yet',
            'state': answer['state']}


# messages


def transform_of(calibration: Calibration, stamp: Time) -> TransformStamped:
    """Return the answer as the pose of the sensor in its parent frame."""
    T = calibration.T_flange_sensor
    return transform_stamped(T[:3, 3], se3.quaternion(T), calibration.parent_frame,
                             calibration.child_frame, stamp)


def transform_stamped(translation: Iterable[float], rotation: Iterable[float], parent: str,
                      child: str, stamp: Time) -> TransformStamped:
    """Return a transform (x y z in m, quaternion x y z w) of a child frame in its parent."""
    msg = TransformStamped(header=Header(stamp=stamp, frame_id=parent), child_frame_id=child)
    _set(msg.transform.translation, translation)
    _set(msg.transform.rotation, rotation)
    return msg


def pose_stamped(translation: Iterable[float], rotation: Iterable[float], frame_id: str,
                 stamp: Time) -> PoseStamped:
    """Return a pose (x y z in m, quaternion x y z w) in a frame."""
    msg = PoseStamped(header=Header(stamp=stamp, frame_id=frame_id))
    _set(msg.pose.position, translation)
    _set(msg.pose.orientation, rotation)
    return msg


def time_message(stamp: int) -> Time:
    """Return a stamp (ns) as a message."""
    sec, nanosec = divmod(stamp, 1_000_000_000)
    return Time(sec=sec, nanosec=nanosec)


def cloud(points: NDArray[Any], frame_id: str, stamp: int) -> PointCloud2:
    """Return a message of points (n,), an array with fields of type float32; stamp: ns."""
    return PointCloud2(
        header=Header(stamp=time_message(stamp), frame_id=frame_id), height=1,
        width=len(points), point_step=points.itemsize, row_step=points.nbytes, is_dense=True,
        fields=[PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1)
                for k, name in enumerate(points.dtype.names or ())],
        data=array('B', points.tobytes()))


def session_markers(samples: Sequence[tuple[int, Sample]], calibration: Calibration | None,
                    config: Config) -> MarkerArray:
    """Return the flanges of samples with their numbers and, with an answer, its scene."""
    stops = [StopSnapshot(number, sample.stamp, in_mount(sample.T_base_flange, config),
                          np.empty((0, 2)), sample.features) for number, sample in samples]
    markers = []
    for stop in stops:
        text = _marker('numbers', Marker.TEXT_VIEW_FACING, FLANGE, LETTER, [])
        text.text = str(stop.number)
        _set(text.pose.position, stop.T_mount[:3, 3])
        markers.append(text)
    if stops:
        flanges = [stop.T_mount[:3, 3] for stop in stops]
        markers.append(_marker('flanges', Marker.POINTS, FLANGE, LETTER / 2, flanges))
    for part in scene(calibration, stops, config)['parts'] if calibration else ():
        kind, points = ((Marker.LINE_STRIP, part['line']) if 'line' in part else
                        (Marker.POINTS, part['points']))
        markers.append(_marker(part['name'], kind, part['color'], DRAWN * part['width'], points))
    return _array(markers, config)


def current_markers(current: Current | None, calibration: Calibration | None, config: Config
                    ) -> MarkerArray:
    """Return the current profile and its features, placed by the answer."""
    if current is None or calibration is None:
        return _array([], config)
    T = in_mount(current.T_base_flange, config) @ calibration.T_flange_sensor
    points = current.points[np.isfinite(current.points).all(axis=1)]
    return _array([_marker(name, Marker.POINTS, color, width * DRAWN,
                           se3.apply(T, in_sensor(plane, config)))
                   for name, color, width, plane in (
                       ('profile', LASER, 1.5, points),
                       ('feature', SEEN, 6.0, in_plane(current.features)))
                   if len(plane)], config)


def _marker(name: str, kind: int, color: str, size: float, points: Iterable[Array]) -> Marker:
    """Return a marker of lines, points (3,) or letters; color: #rrggbb, size: m."""
    red, green, blue = (int(color[k:k + 2], 16) / 255 for k in (1, 3, 5))
    marker = Marker(ns=name, type=kind, action=Marker.ADD,
                    color=ColorRGBA(r=red, g=green, b=blue, a=1.0))
    marker.points = [_set(Point(), point) for point in points]
    _set(marker.scale, (size, size, size))
    marker.pose.orientation.w = 1.0
    return marker


def _array(markers: list[Marker], config: Config) -> MarkerArray:
    """Return markers in the frame of the target, in place of all before."""
    markers = [Marker(action=Marker.DELETEALL), *markers]
    for number, marker in enumerate(markers):
        marker.header.frame_id, marker.id = target_frame(config), number
    return MarkerArray(markers=markers)


def _set(msg: Any, values: Iterable[float]) -> Any:
    """Set the fields x, y, z (and w) of a message; return it."""
    for name, value in zip('xyzw', values):  # noqa: B905 - three or four
        setattr(msg, name, float(value))
    return msg
