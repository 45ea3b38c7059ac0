"""What /diagnostics tells of the node, once a second."""
from __future__ import annotations

from collections.abc import Callable

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from handeye_ros.ros.node.live import LiveSession
from handeye_ros.ros.node.wording import calibration_summary, count_of
from std_msgs.msg import Header

SILENCE = 2.0  # s without a message after which a person should look


def diagnostics(live: LiveSession, name: str, stamp: Time, obstacle: Callable[[str], str]
                ) -> DiagnosticArray:
    """Return the state of a session; obstacle: tells why no profile, or pose, comes in."""
    troubles = _troubles(live, obstacle)
    samples = len(live.samples)
    status = DiagnosticStatus(
        name=f'{name}: calibration', hardware_id=live.config.robot_effector_frame,
        level=DiagnosticStatus.WARN if troubles else DiagnosticStatus.OK,
        message='; '.join(troubles) or count_of(samples, 'sample'))
    values = {
        'profiles': live.arrivals.counts['profile'], 'poses': live.arrivals.counts['pose'],
        'malformed messages': live.arrivals.counts['malformed'],
        'last malformed': live.arrivals.last_malformed,
        'seconds since the last profile': f'{live.arrivals.silence("profile"):.1f}',
        'seconds since the last pose': f'{live.arrivals.silence("pose"):.1f}',
        'samples': samples, 'last refusal': live.last_refusal,
        'dropped': '; '.join(live.warnings),
        'calibration': calibration_summary(live.calibration) if live.calibration else 'none yet',
    }
    status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticArray(header=Header(stamp=stamp), status=[status])


def _troubles(live: LiveSession, obstacle: Callable[[str], str]) -> list[str]:
    config = live.config
    by_topic = config.pose_source == 'topic'
    places = {'profile': f'on {config.profile_topic}',
              'pose': f'on {config.pose_topic}' if by_topic else 'from /tf'}
    silences = [_silence(live, kind, place, obstacle) for kind, place in places.items()]
    return [trouble for trouble in (*silences, live.trouble) if trouble]


def _silence(live: LiveSession, kind: str, place: str, obstacle: Callable[[str], str]) -> str:
    seconds = live.arrivals.silence(kind)
    if seconds < SILENCE:
        return ''
    none = 'no' if live.arrivals.counts[kind] == 0 else 'no more'
    why = obstacle(kind)
    return f'{none} {kind}s {place} for {seconds:.0f} s' + (f' ({why})' if why else '')
