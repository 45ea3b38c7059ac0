"""The corrected arm from samples of profiles: its joint values, and the answer of the pipeline."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from handeye_ros import pipeline, se3
from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Array, Calibration, Reject, Sample, TimedPose
from handeye_ros.diagnosis.settings import require_same_clock
from handeye_ros.estimation.linearise import Problem
from handeye_ros.estimation.solution import covering
from handeye_ros.frames import in_mount
from handeye_ros.kinematics.answer import Answer, compared
from handeye_ros.kinematics.errors import (
    cause_of,
    Change,
    ContradictionError,
    judged_joints,
    NoJointValuesError,
    OTHER_SIDE,
    TooFewConfigurationsError,
)
from handeye_ros.kinematics.estimate import fit_of, MINIMUM
from handeye_ros.kinematics.model import Arm, Chain
from handeye_ros.kinematics.outcome import AGREEING, Outcome, solve
from handeye_ros.kinematics.profiles import misfit, profiles_of
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

LONGEST_GAP = 1_000_000_000  # ns, between a sample and joint values


@dataclass(frozen=True, eq=False)
class JointRecording:
    """
    A recording of profiles and joint values.

    poses: the flange poses of the arm as stated, at the joint values (n, joints); reported: the
    controller's own, empty where there are none; warnings, inputs: of the reading.
    """

    profiles: Sequence[AnyProfile]
    poses: Sequence[TimedPose]
    joints: Array
    reported: Sequence[TimedPose]
    warnings: Sequence[str]
    inputs: Sequence[dict[str, str]]


@dataclass(frozen=True, eq=False)
class Source:
    """
    Samples of one target, their poses those of the arm as stated, with joint values.

    joints: (n, joints) at stamps (n,); recording: what the samples come from, None for stops of a
    session; require_same_clock: raises where the clocks are why they contradict each other;
    inputs, warnings: of the reading.
    """

    samples: Sequence[Sample]
    rejects: Sequence[Reject]
    frame_id: str
    config: Config
    stamps: NDArray[np.int64]
    joints: Array
    recording: JointRecording | None = None
    require_same_clock: Callable[[Config], None] | None = None
    inputs: Sequence[dict[str, str]] = ()
    warnings: Sequence[str] = ()

    @classmethod
    def of(cls, samples: Sequence[Sample], rejects: Sequence[Reject], frame_id: str,
           config: Config, chain: Chain, stamps: NDArray[np.int64], joints: Array, **more: Any
           ) -> Source:
        """Return samples whose settings have the frames of a chain; more: the other fields."""
        return cls(samples, rejects, frame_id, _configured(config, chain), stamps, joints, **more)

    def joints_at(self, samples: Sequence[Sample]) -> Array:
        """Return the joint values (k, joints) at samples; raises NoJointValuesError."""
        at = np.array([sample.stamp + round(sample.offsets[0] * 1e9) for sample in samples])
        after = np.searchsorted(self.stamps, at)
        near = np.minimum(*(np.abs(self.stamps[np.clip(after - k, 0, len(self.stamps) - 1)] - at)
                            for k in (0, 1)))
        if (near > LONGEST_GAP).any():
            raise NoJointValuesError(int((near > LONGEST_GAP).sum()), len(at))
        return at_stamps(at, self.stamps, self.joints)

    def calibrated(self, arm: Arm) -> Calibration:
        """Return the calibration with the poses of a corrected arm; raises DataError."""
        recording = self.recording
        if recording:
            T = arm.forward(recording.joints)
            poses = [replace(pose, translation=own[:3, 3], quaternion=q) for pose, own, q in zip(
                recording.poses, T, se3.quaternion(T), strict=True)]
            return pipeline.calibrate(recording.profiles, poses, self.config)
        T = arm.forward(self.joints_at(self.samples))
        stops = [replace(sample, T_base_flange=own, motion=None)
                 for sample, own in zip(self.samples, T, strict=True)]
        return pipeline.solve(stops, self.rejects, self.config, self.frame_id)


def source_of(recording: JointRecording, chain: Chain, config: Config) -> Source:
    """Return the samples of a recording; raises DataError."""
    config = _configured(config, chain)
    stamps = np.array([pose.stamp for pose in recording.poses])
    odd = judged_joints(chain, chain.given(recording.joints))
    session = pipeline.gather(recording.profiles, recording.poses, config)
    source = Source(session.samples, session.rejects, session.frame_id, config, stamps,
                    recording.joints, recording, partial(require_same_clock, session),
                    recording.inputs)
    compared = _compared(recording, source, chain) if recording.reported else ''
    return replace(source, warnings=[*filter(None, (
        *recording.warnings, *session.warnings, *odd, compared))])


def _configured(config: Config, chain: Chain) -> Config:
    """Return settings with the frames of a chain, whose poses come from joint values."""
    return replace(config, kinematics='', pose_source='topic', robot_base_frame=chain.base,
                   robot_effector_frame=chain.flange)


def solve_sources(sources: Sequence[Source], chain: Chain, more: Sequence[str],
                  inputs: Sequence[dict[str, str]] = ()) -> Answer:
    """
    Return the corrected arm, and the calibration that belongs to it; raises DataError.

    sources: of one sensor on one robot; each has seen a target, or the same at another place.
    inputs: what else the answer comes from.
    """
    try:
        outcome = outcome_of(sources, chain, more)
    except (ContradictionError, TooFewConfigurationsError):
        for source in sources:
            if source.require_same_clock:
                source.require_same_clock(source.config)
        raise
    calibrations = [source.calibrated(outcome.arm) for source in sources]
    inputs = [*(values for source in sources for values in source.inputs), *inputs]
    warnings = list(dict.fromkeys(w for source in sources for w in source.warnings))
    return Answer.of(outcome, _together(calibrations, outcome), inputs, warnings)


def _together(calibrations: Sequence[Calibration], outcome: Outcome) -> Calibration:
    """Return the calibration of all targets: the transform of several is that of the outcome."""
    first, own = calibrations[0], outcome.covariance[:6, :6]
    if len(calibrations) == 1:
        return replace(first, covariance=covering(first.covariance, own))
    qualities = [each.quality for each in calibrations]
    quality = replace(first.quality, samples_used=sum(q.samples_used for q in qualities),
                      samples_rejected=sum(q.samples_rejected for q in qualities),
                      residual_rms=max(q.residual_rms for q in qualities),
                      holdout_rms=max(q.holdout_rms for q in qualities))
    reports = tuple(report for each in calibrations for report in each.samples)
    return replace(first, T_flange_sensor=outcome.chosen.fit.state.X, covariance=own,
                   quality=quality, samples=reports)


def outcome_of(sources: Sequence[Source], chain: Chain, more: Sequence[str]) -> Outcome:
    """Return the corrected arm, of a robot that stops or moves; raises DataError."""
    count = sum(len(source.samples) for source in sources)
    limit = sources[0].config.limits.residual
    if count < MINIMUM:
        raise TooFewConfigurationsError(count, MINIMUM)
    problems, joints = zip(*(_problem(source, chain) for source in sources), strict=True)

    def missed(change: Change) -> float:
        return max(misfit(_changed(problem, chain.forward(q @ change.joints.T), change))
                   for problem, q in zip(problems, joints, strict=True))

    def cause() -> str:
        return cause_of(chain, np.concatenate(joints), problems[0].in_hand, missed)
    data, state = profiles_of(problems, joints, Arm(chain))
    if len(data) < max(MINIMUM, AGREEING * count):
        raise ContradictionError(missed(Change('', np.eye(len(chain.joints)))), limit, cause())
    return solve(fit_of(data, state), more, limit, cause)


def _problem(source: Source, chain: Chain) -> tuple[Problem, Array]:
    """Return what a source shows, with the arm as stated, and the joint values (n, joints)."""
    ordered, problem = pipeline.at_stops(source.samples, source.config)
    q = source.joints_at(ordered)
    return replace(problem, poses=in_mount(chain.forward(q), source.config)), q


def _changed(problem: Problem, T_base_flange: Array, change: Change) -> Problem:
    """Return a problem with other poses (n, 4, 4), and what else is changed."""
    config = problem.config
    if change.other_side:
        config = replace(config, calibration_type=OTHER_SIDE[config.calibration_type])
    return replace(problem, poses=in_mount(T_base_flange, config), config=config)


def _compared(recording: JointRecording, source: Source, chain: Chain) -> str:
    """Return in words how the controller's poses differ from those of the URDF, at samples."""
    reported = np.array([pose.stamp for pose in recording.reported])
    times, first = np.unique(reported - reported[0], return_index=True)
    at = np.array([sample.stamp for sample in source.samples])
    at = at[(at >= reported[0]) & (at <= reported[-1])]
    if len(times) < 2 or not len(at):
        return 'the reported poses are of another time than the profiles, and are not compared'
    poses = [recording.reported[i] for i in first]
    T = se3.interpolated(times.astype(float), np.array([p.translation for p in poses]),
                         np.array([p.quaternion for p in poses]),
                         (at - reported[0]).astype(float))
    return compared(T, chain.forward(at_stamps(at, source.stamps, source.joints)))


def at_stamps(at: NDArray[np.int64], stamps: NDArray[np.int64], joints: Array) -> Array:
    """Return joint values (k, joints) at some stamps, between those (n, joints) of stamps (n,)."""
    times, first = np.unique(stamps - stamps[0], return_index=True)
    spline = PchipInterpolator(times * 1e-9, joints[first])
    return np.asarray(spline(np.clip(at - stamps[0], times[0], times[-1]) * 1e-9))
