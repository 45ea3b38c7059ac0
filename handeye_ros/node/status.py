"""Collects the state of a running node at one time."""
from __future__ import annotations

from collections.abc import Callable

from handeye_ros import se3
from handeye_ros.checks.review import Agreement, sample_summary
from handeye_ros.guidance.advice import Advice
from handeye_ros.node.answer import Answer, Reviewer, stamps_of
from handeye_ros.node.live import LiveSession
from handeye_ros.node.state import (
    calibration_summary,
    CalibrationState,
    CURRENT,
    GuidanceState,
    MotionState,
    NONE,
    OUTDATED,
    SampleState,
    SessionState,
    SigmaState,
    State,
    StreamState,
    WITHDRAWN,
)
from handeye_ros.output import folder_name
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Outcome
import numpy as np

NO_ANSWER = 'no calibration has been computed yet'
SILENCE = 2.0  # s without a message until it is reported

Obstacle = Callable[[str], str]


def state_of(live: LiveSession, obstacle: Obstacle = lambda kind: '', same_name: str = ''
             ) -> State:
    """
    Return the state of a running node.

    obstacle: returns why no messages of a kind (profile, pose) arrive; same_name: a sentence if
    another node has the same name.
    """
    session, config = live.copied(), live.config
    by_topic = config.pose_source == 'topic'
    agreements = _agreements(live.reviewer)
    samples = tuple(_sample(outcome, session, agreements.get(outcome.number))
                    for outcome in session.outcomes)
    worst = sorted((s for s in samples if s.left_out is not None),
                   key=lambda s: s.left_out or 0.0, reverse=True)
    return State(
        folder_name(config),
        _stream(live, 'profile', config.profile_topic, session.frame_id, obstacle),
        _stream(live, 'pose', config.pose_topic if by_topic else '/tf', '', obstacle),
        _motion(session),
        SessionState(live.samples.store.path, config.sampling.mode, live.progress.text,
                     _trouble(live, session, same_name), (*session.warnings, *live.warnings)),
        samples, tuple(sample.number for sample in worst), live.reviewer.no_review,
        live.samples.attempt,
        _calibration(live.answer, stamps_of(session)),
        _guidance(live.reviewer.advice, live.reviewer.advised))


def _calibration(answer: Answer, stamps: frozenset[int]) -> CalibrationState:
    """Return the answer as plain values; stamps: of the current samples."""
    calibration = answer.calibration
    if calibration is None:
        return CalibrationState(WITHDRAWN if answer.withdrawn else NONE,
                                answer.withdrawn or ': '.join(filter(None, [
                                    NO_ANSWER, answer.missing])))
    changes, T = answer.changes(stamps), calibration.T_flange_sensor
    quality = calibration.quality
    return CalibrationState(
        OUTDATED if changes else CURRENT, calibration_summary(calibration) + changes,
        calibration.parent_frame, calibration.child_frame, _plain(T[:3, 3]),
        _plain(se3.quaternion(T)), _plain(se3.rpy(T)),
        _plain(np.sqrt(np.diag(calibration.covariance))), quality.residual_rms,
        quality.holdout_rms, quality.samples_used, quality.samples_rejected, answer.file)


def _guidance(advice: Advice | None, sample: int) -> GuidanceState | None:
    """Return the guidance as plain values; sample: the number of the last one included."""
    if advice is None:
        return None
    pose = advice.next
    sigmas = tuple(SigmaState(s.name, s.std, s.limit, s.unit) for s in advice.sigmas)
    prefix = f'after sample {sample}: ' if sample else ''
    return GuidanceState(
        sample, prefix + advice.text, advice.sentences, advice.enough, advice.why, sigmas,
        _plain(pose.T_base_flange[:3, 3]) if pose else None,
        _plain(se3.quaternion(pose.T_base_flange)) if pose else None, pose.std if pose else None)


def _agreements(reviewer: Reviewer) -> dict[int, Agreement]:
    """Return the residuals of the last review by the number of the sample."""
    review = reviewer.review
    if review is None:
        return {}
    pairs = zip(reviewer.reviewed, review.agreements, strict=False)
    return {outcome.number: agreement for outcome, agreement in pairs if agreement}


def _stream(live: LiveSession, kind: str, topic: str, frame: str, obstacle: Obstacle
            ) -> StreamState:
    arrivals = live.streams.arrivals
    trouble = arrivals.unusable(kind) or _silence(live, kind, topic, obstacle)
    return StreamState(kind, topic, arrivals.counts[kind], arrivals.bad[kind],
                       arrivals.silence(kind), frame, trouble)


def _silence(live: LiveSession, kind: str, topic: str, obstacle: Obstacle) -> str:
    seconds = live.streams.arrivals.silence(kind)
    if seconds < SILENCE:
        return ''
    quantity = 'no' if live.streams.arrivals.counts[kind] == 0 else 'no more'
    reason = obstacle(kind)
    source = 'from' if topic == '/tf' else 'on'
    text = f'{quantity} {kind}s {source} {topic} for {seconds:.0f} s'
    return f'{text} ({reason})' if reason else text


def _motion(session: Session) -> MotionState:
    motion = session.motion
    if motion is None:
        return MotionState(False, 0.0, 0.0, 0.0, 'too few poses have come to measure its motion')
    return MotionState(session.is_standing, motion.speed, motion.turning, motion.still,
                       motion.sentence)


def _trouble(live: LiveSession, session: Session, same_name: str) -> str:
    """Return why current messages cannot be used, and the advice; '' if they can."""
    late = (f'{" and ".join(session.late)} are dropped, as their stamps are older than those '
            'before: sampling continues by itself if the clock was set back'
            ) if session.late else ''
    troubles = (str(session.conflict or ''), late, live.streams.arrivals.clocks, session.unasked,
                live.samples.store_trouble, live.threads.failure, same_name)
    return '; '.join(filter(None, troubles))


def _sample(outcome: Outcome, session: Session, agreement: Agreement | None) -> SampleState:
    sample, excluded = outcome.sample, session.excludes(outcome)
    text = sample_summary(outcome.result)
    if sample is None:
        return SampleState(outcome.number, outcome.result.stamp, False, excluded, False, text)
    T = sample.T_base_flange
    return SampleState(
        outcome.number, sample.stamp, True, excluded,
        not excluded and (agreement is None or agreement.used), text,
        agreement.residual if agreement else None, agreement.left_out if agreement else None,
        _plain(T[:3, 3]), _plain(se3.quaternion(T)))


def _plain(values: object) -> tuple[float, ...]:
    """Return numbers as types for JSON and messages."""
    return tuple(float(value) for value in np.asarray(values))
