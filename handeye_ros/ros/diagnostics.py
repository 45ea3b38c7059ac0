"""What /diagnostics tells of the node, once a second."""
from __future__ import annotations

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from handeye_ros.ros.live import LiveSession
from handeye_ros.ros.wording import calibration_summary, count_of
from std_msgs.msg import Header

SILENCE = 2.0  # s without a message after which a person should look


def diagnostics(live: LiveSession, name: str, stamp: Time, no_poses: str) -> DiagnosticArray:
    """Return the state of a session; no_poses: why transforms give none, or empty."""
    troubles = _troubles(live, no_poses)
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


def _troubles(live: LiveSession, no_poses: str) -> list[str]:
    config = live.config
    profiles = _silence(live, 'profile', f'on {config.profile_topic}')
    if config.pose_source == 'tf':
        poses = _silence(live, 'pose', f'from /tf ({no_poses})' if no_poses else 'from /tf')
    else:
        poses = _silence(live, 'pose', f'on {config.pose_topic}')
    return [trouble for trouble in (profiles, poses) if trouble]


def _silence(live: LiveSession, kind: str, place: str) -> str:
    seconds = live.arrivals.silence(kind)
    if seconds < SILENCE:
        return ''
    none = 'no' if live.arrivals.counts[kind] == 0 else 'no more'
    return f'{none} {kind}s {place} for {seconds:.0f} s'
