# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The state of a running node as plain values, and sentences about it.

Services, /diagnostics, ~/samples, ~/status and the page all report these values, so that they
agree and use the same sentences. SI units. docs/contract.md documents the fields of ~/samples and
~/status; the functions here document the others.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any, TYPE_CHECKING

from handeye_ros import se3
from handeye_ros.config import MAX_TIME_OFFSET
from handeye_ros.data import Agreement, Array
from handeye_ros.node.message_counts import MessageCount
from handeye_ros.node.solver import LiveSolver, Review, summary
from handeye_ros.output import folder_name
from handeye_ros.results.printed import sample_summary
from handeye_ros.sampling.input_faults import (
    late_streams,
    unrequested_stops_notice,
    unusable_poses_error,
)
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import NO_STOP, Stop
import numpy as np

if TYPE_CHECKING:
    from handeye_ros.node.live import LiveSession

State = dict[str, Any]
"""What `state_of` returns; its parts (profiles, poses, motion, session, ...) are plain dicts."""

NONE, CURRENT, OUTDATED, WITHDRAWN = 'none', 'current', 'outdated', 'withdrawn'
NO_ANSWER = {
    'parent': '', 'child': '', 'translation': None, 'rotation': None, 'rpy': None, 'std': None,
    'residual_rms': None, 'holdout_rms': None, 'used': 0, 'rejected': 0, 'saved': ''}
FRESH_TIME = 1.0  # s: the clocks are compared if the last messages of both kinds are not older
MAX_CLOCK_DIFFERENCE = 5.0  # s, that a slow network or a queue explains


@dataclass(frozen=True, eq=False)
class Attempt:
    """An attempt to take a sample: what is told of it, and its stop if that was evaluated."""

    text: str
    stop: Stop = NO_STOP


def _clock_trouble(profiles: MessageCount, poses: MessageCount, time_offset: float) -> str:
    """Return a sentence if the clocks of profiles and poses differ, '' otherwise."""
    if not profiles.stamp or not poses.stamp or max(profiles.silence, poses.silence) > FRESH_TIME:
        return ''
    ahead = (profiles.stamp - poses.stamp) * 1e-9 + profiles.silence - poses.silence
    if abs(ahead) < MAX_CLOCK_DIFFERENCE:
        return ''
    offset = time_offset - ahead
    remedy = f', or set time_offset to {offset:.1f}' if abs(offset) <= MAX_TIME_OFFSET else ''
    return (f'the stamps of the profiles are {abs(ahead):.1f} s '
            f'{"ahead of" if ahead > 0 else "behind"} those of the poses: the clocks of sensor '
            'and robot differ; set them to one time (PTP or NTP), or let one driver stamp as the '
            f'other does{remedy}')


def state_of(live: LiveSession, graph_troubles: Mapping[str, str] = MappingProxyType({}),
             session: Session | None = None) -> State:
    """
    Return the state of a running node; graph_troubles: as in streams.py, '' unless known.

    session: the copy of the session to tell it of, None for one of this moment.
    motion: whether the robot stands long enough for a sample (standing), and how it moves (text);
    session: its folder, the running tasks (working), why messages cannot be used or stops not be
    stored (trouble), each of these '' without any, and what else was dropped or continues
    (warnings, a list of sentences); review_refusal: why the review has no answer, '', which is
    `review` in ~/samples. For profiles and poses see MessageCount.state, for calibration and
    guidance below, for the others docs/contract.md.
    """
    session, config, attempt = session or live.session_copy(), live.config, live.attempt
    review, motion = live.solver.review, session.motion
    graph_trouble = graph_troubles.get('session', '')
    profiles, poses = live.message_counts['profile'], live.message_counts['pose']
    samples = [_stop_row(stop, session, review.agreements.get(stop.number))
               for stop in session.stops]
    worst_first = sorted((sample for sample in samples if sample['left_out'] is not None),
                         key=lambda sample: -sample['left_out'])
    late, conflict = ' and '.join(late_streams(session.streams)), session.conflict
    troubles = (
        graph_trouble, str(conflict or ''),
        'all samples are of the first: ~/clear_samples begins anew with the frame of now'
        if conflict and conflict.code == 'two_frames' and session.samples else '',
        late and f'{late} are dropped, as their stamps are older than those before; if they stay '
        'so, sampling goes on with them',
        str(unusable_poses_error(session.pose_stream, session.flange_distance) or ''),
        # of two publishers stamps that seem to be of two clocks follow
        '' if graph_trouble else _clock_trouble(profiles, poses, config.time_offset),
        unrequested_stops_notice(session.unrequested_count), live.storing_trouble,
        live.worker.trouble)
    return {
        'name': folder_name(config),
        'profiles': profiles.state(config.profile_topic, graph_troubles.get('profile', '')),
        'poses': poses.state(config.topic_of_poses, graph_troubles.get('pose', '')),
        'motion': {
            'standing': session.is_standing,
            'text': motion.sentence if motion else 'too few poses have come to measure it'},
        'session': {'path': live.path, 'mode': config.sampling.mode, 'working': live.working,
                    'trouble': '; '.join(filter(None, troubles)),
                    'warnings': [*session.warnings, *live.warnings]},
        'samples': samples, 'worst_first': [sample['number'] for sample in worst_first],
        'review_refusal': '' if review.answer.solution else str(review.answer.refusal),
        'attempt': attempt and {'accepted': attempt.stop.sample is not None,
                                'number': attempt.stop.number, 'text': attempt.text},
        'calibration': _calibration(live.solver, session), 'guidance': _guidance(review)}


def sample_count(state: State) -> int:
    """Return the number of samples, including excluded ones."""
    return sum(sample['taken'] for sample in state['samples'])


def troubles_of(state: State) -> list[str]:
    """Return why messages cannot be used, one sentence for each cause."""
    sentences = [state[part]['trouble'] for part in ('profiles', 'poses', 'session')]
    return [sentence for sentence in sentences if sentence]


def with_troubles(state: State, text: str, success: bool, service: str) -> str:
    """
    Return the message of a service with the current troubles.

    take_sample always tells them. What is refused may follow from a trouble, which is told first;
    where no message can be used, it does.
    """
    troubles = [sentence for sentence in troubles_of(state) if sentence not in text]
    if success:
        return '; '.join([text, *troubles]) if service == 'take_sample' else text
    unusable = service in ('take_sample', 'compute_calibration') and any(
        state[part]['malformed'] and not state[part]['count'] for part in ('profiles', 'poses'))
    follows = unusable or any(text in sentence for sentence in troubles)
    return '; '.join(troubles if follows else [*troubles, text])


def samples_message(state: State) -> dict[str, Any]:
    """Return the content of ~/samples, as plain values."""
    return {'format': 'handeye_ros/samples/1', 'session': state['session']['path'],
            'mode': state['session']['mode'], 'review': state['review_refusal'],
            **{key: state[key] for key in ('samples', 'worst_first', 'attempt')}}


def status_message(state: State) -> dict[str, Any]:
    """Return the content of ~/status, as plain values."""
    return {'format': 'handeye_ros/status/1', **state['calibration']}


def _stop_row(stop: Stop, session: Session, agreement: Agreement | None) -> dict[str, Any]:
    """
    Return one stop of the robot.

    taken: whether it gave a sample; excluded: whether samples.exclude names it; believed: whether
    it is taken, not excluded, and used by the fit, or not yet compared with one (no residual);
    text: its features, or why there is no sample; residual, left_out: RMS (m), None without a fit;
    translation, rotation: the flange in the base (quaternion x y z w), None without a sample.
    """
    sample, excluded = stop.sample, session.excludes(stop)
    return {
        'number': stop.number, 'stamp': stop.result.stamp, 'taken': sample is not None,
        'excluded': excluded,
        'believed': sample is not None and not excluded and (agreement is None or agreement.used),
        'text': sample_summary(stop.result),
        'residual': agreement and agreement.residual, 'left_out': agreement and agreement.left_out,
        **_pose(sample.T_base_flange if sample else None)}


def _pose(T: Array | None) -> dict[str, Any]:
    """Return a transform (4, 4), or None, as translation and rotation (quaternion x y z w)."""
    return {'translation': None if T is None else T[:3, 3].tolist(),
            'rotation': None if T is None else se3.quaternion(T).tolist()}


def _calibration(solver: LiveSolver, session: Session) -> dict[str, Any]:
    """
    Return the answer and its state.

    state: none, current, outdated (samples have changed since) or withdrawn (the
    transform that was published before is not valid). translation, rotation (x y z w), rpy: of the
    child in the parent; std: 1 sigma of x y z rx ry rz; all None without an answer. saved: the
    file of this answer, empty before it is saved.
    """
    calibration = solver.calibration
    if calibration is None:
        state, note = NONE, ''
        if solver.solved_session:
            state, note = WITHDRAWN, '; the transform that was published before is not the answer'
        return {**NO_ANSWER, 'state': state, 'text': f'{solver.why_missing}{note}'}
    changes, quality = solver.changes_since(session), calibration.quality
    return {
        'state': OUTDATED if changes else CURRENT,
        'text': '; '.join(filter(None, (summary(calibration), changes))),
        'parent': calibration.parent_frame, 'child': calibration.child_frame,
        **_pose(calibration.T_flange_sensor), 'rpy': se3.rpy(calibration.T_flange_sensor).tolist(),
        'std': np.sqrt(np.diag(calibration.covariance)).tolist(),
        'residual_rms': quality.residual_rms, 'holdout_rms': quality.holdout_rms,
        'used': quality.samples_used, 'rejected': quality.samples_rejected, 'saved': solver.saved}


def _guidance(review: Review) -> dict[str, Any]:
    """
    Return the guidance.

    sample: the number of the last sample that it includes, 0 for none; text: the complete text,
    with that number; sentences: its sentences; enough: whether the samples suffice; sigmas: of
    each direction, last that of mapped points, empty before there is an answer; translation,
    rotation: the flange in the base at the most useful next pose (quaternion x y z w), None before
    a first estimate of the sensor's pose.
    """
    advice, sample = review.advice, review.advised
    return {
        'sample': sample, 'text': (f'after sample {sample}: ' if sample else '') + advice.text,
        'sentences': list(advice.sentences), 'enough': advice.enough,
        'sigmas': [asdict(sigma) for sigma in advice.sigmas],
        **_pose(advice.next_pose.T_base_flange if advice.next_pose else None)}
