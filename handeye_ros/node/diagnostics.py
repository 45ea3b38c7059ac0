"""Diagnostics of the node: /diagnostics, reasons for silent topics, repeated warnings."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
import re
import time

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from handeye_ros.checks.review import count_of
from handeye_ros.node.state import CURRENT, NONE, State, WITHDRAWN
from handeye_ros.node.streams import Arrivals
from rclpy.node import Node
from std_msgs.msg import Header

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
PERIOD = 10.0  # s until a lasting warning is repeated
LISTED = 5  # largest number of topics in a sentence
HINTS = {  # why another message type cannot be used, or the remedy
    'geometry_msgs/msg/Pose': ', as a Pose has no time',
    'geometry_msgs/msg/PoseWithCovarianceStamped': ', without the covariance',
    'geometry_msgs/msg/TransformStamped': ' (or set pose_source to tf)',
    'sensor_msgs/msg/LaserScan': ': let the driver publish its points',
    'sensor_msgs/msg/PointCloud': ', its successor',
}


def diagnostics(state: State, arrivals: Arrivals, name: str, stamp: Time) -> DiagnosticArray:
    """
    Return the state as diagnostics; name: of the node, with its namespace.

    Levels: ERROR if no usable message of a kind was ever received, or a published answer was
    withdrawn; WARN if the operator should check.
    """
    statuses = [DiagnosticStatus(
        name=f'{name}: {concern}', hardware_id=state.name, level=level, message=message,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
        for concern, level, message, values in _concerns(state, arrivals)]
    return DiagnosticArray(header=Header(stamp=stamp), status=statuses)


def _concerns(state: State, arrivals: Arrivals
              ) -> Iterator[tuple[str, bytes, str, dict[str, object]]]:
    for stream in (state.profiles, state.poses):
        level = OK if not stream.trouble else WARN if stream.count else ERROR
        yield f'{stream.kind}s', level, (
            stream.trouble or f'{count_of(stream.count, stream.kind)} on {stream.topic}'), {
            f'{stream.kind}s': stream.count, f'malformed {stream.kind}s': stream.malformed,
            f'seconds since the last {stream.kind}': f'{stream.age:.1f}',
            f'topic of the {stream.kind}s': stream.topic}
    session, attempt = state.session, state.attempt
    yield 'session', WARN if session.trouble else OK, (
        session.trouble or session.working or count_of(state.taken, 'sample')), {
        'samples': state.taken, 'mode': session.mode, 'folder': session.path or 'none yet',
        'robot': state.motion.text, 'dropped': '; '.join(session.notes),
        'last attempt': attempt.text if attempt else 'none yet',
        'last refusal': _last_refusal(state),
        'malformed messages': arrivals.counts['malformed'],
        'last malformed': arrivals.last_malformed,
        'worst first': ', '.join(map(str, state.worst)) or state.review}
    answer = state.calibration
    level = {CURRENT: OK, NONE: OK, WITHDRAWN: ERROR}.get(answer.state, WARN)
    yield 'calibration', level, answer.text, {
        'calibration': answer.text if answer.translation else 'none yet',
        'state': answer.state}


def _last_refusal(state: State) -> str:
    refused = [sample.text for sample in state.samples if not sample.taken]
    if state.attempt and not state.attempt.accepted:
        return state.attempt.text
    return refused[-1] if refused else ''


def why_silent(node: Node, key: str, topic: str, message_type: str) -> str:
    """
    Return why no messages of a type arrive; empty if there is a publisher.

    key: of the configuration that names the topic.
    """
    name = node.resolve_topic_name(topic)
    types = {info.topic_type for info in node.get_publishers_info_by_topic(name)}
    if message_type in types:
        return ''
    hints = ''.join(HINTS.get(kind, '') for kind in sorted(types))
    reason = f'{name} has no publisher' if not types else (
        f'it carries {", ".join(sorted(types))}, expected {message_type}{hints}')
    alternatives = topics_of(node, message_type)
    if alternatives:
        reason += f'; {message_type} is on {", ".join(alternatives[:LISTED])}: set {key}'
    return reason


def same_name(node: Node) -> str:
    """Return the advice if another node has the same name, '' otherwise."""
    own_name = (node.get_name(), node.get_namespace())
    if node.get_node_names_and_namespaces().count(own_name) < 2:
        return ''
    return (f'there are two nodes {node.get_fully_qualified_name()}: both take samples, and '
            'either may answer; end one, or rename it (-r __node:=other). One that was killed '
            'is listed for 20 s more')


def topics_of(node: Node, message_type: str) -> list[str]:
    """Return the topics with publishers of a message type."""
    names = [name for name, types in node.get_topic_names_and_types() if message_type in types]
    own_name = (node.get_name(), node.get_namespace())
    return sorted(name for name in names
                  if any(info.topic_type == message_type
                         and (info.node_name, info.node_namespace) != own_name
                         for info in node.get_publishers_info_by_topic(name)))


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
