"""What /diagnostics tells of the node, once a second: one status for each concern."""
from __future__ import annotations

from collections.abc import Iterator

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from handeye_ros.diagnosis.summaries import count_of
from handeye_ros.ros.node.arrivals import Arrivals
from handeye_ros.sampling.state import CURRENT, NONE, State, StreamState, WITHDRAWN
from std_msgs.msg import Header

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


def diagnostics(state: State, arrivals: Arrivals, name: str, stamp: Time) -> DiagnosticArray:
    """
    Return the state of a session; name: of the node, with its namespace.

    Levels: ERROR where nothing usable of a kind ever came, or what was published is no answer
    any more; WARN where a person should look.
    """
    statuses = [DiagnosticStatus(
        name=f'{name}: {concern}', hardware_id=state.name, level=level, message=message,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()])
        for concern, level, message, values in _concerns(state, arrivals)]
    return DiagnosticArray(header=Header(stamp=stamp), status=statuses)


def _concerns(state: State, arrivals: Arrivals
              ) -> Iterator[tuple[str, bytes, str, dict[str, object]]]:
    for stream in (state.profiles, state.poses):
        level = _stream_level(stream)
        yield f'{stream.kind}s', level, stream.trouble or _coming(stream), {
            f'{stream.kind}s': stream.count, f'malformed {stream.kind}s': stream.malformed,
            f'seconds since the last {stream.kind}': f'{stream.age:.1f}',
            f'topic of the {stream.kind}s': stream.place}
    session = state.session
    attempt = state.attempt
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


def _stream_level(stream: StreamState) -> bytes:
    if not stream.trouble:
        return OK
    return ERROR if stream.count == 0 else WARN


def _coming(stream: StreamState) -> str:
    return f'{count_of(stream.count, stream.kind)} on {stream.place}'


def _last_refusal(state: State) -> str:
    refused = [sample.text for sample in state.samples if not sample.taken]
    if state.attempt and not state.attempt.accepted:
        return state.attempt.text
    return refused[-1] if refused else ''
