"""The corrected arm from samples of profiles: its joint values, and the answer of the pipeline."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from handeye_ros import pipeline, se3, targets
from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Array, Reject, Sample, TimedPose
from handeye_ros.estimation.linalg import covering
from handeye_ros.estimation.linearise import Problem
from handeye_ros.kinematics.answer import Answer
from handeye_ros.kinematics.chain import Chain
from handeye_ros.kinematics.errors import DEFAULT_CAUSE, TooFewConfigurationsError
from handeye_ros.kinematics.estimate import fit_of, MINIMUM
from handeye_ros.kinematics.model import Arm
from handeye_ros.kinematics.outcome import answer_of, Outcome, solve
from handeye_ros.kinematics.profiles import profiles_of
from handeye_ros.kinematics.table import judged_joints
from handeye_ros.results.outcome import in_mount
from handeye_ros.sampling.edge_shapes import consistent_edges
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.time_offset import synchronised
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

OTHER_FRAMES = 0.02  # m; poses further off are of other frames than the URDF's
EQUAL = 5e-5  # m; rounding of reported poses


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


def solve_recording(recording: JointRecording, chain: Chain, more: Sequence[str], config: Config
                    ) -> Answer:
    """Return the corrected arm and the calibration that belongs to it; raises DataError."""
    config = replace(config, kinematics='', pose_source='topic', robot_base_frame=chain.base,
                     robot_effector_frame=chain.flange)
    joints, stamps = recording.joints, np.array([pose.stamp for pose in recording.poses])
    odd = judged_joints(chain, {joint.follows: column for joint, column in zip(
        chain.joints, joints.T, strict=True) if joint.follows == joint.name})
    session = pipeline.gather(recording.profiles, recording.poses, config)
    told = [*recording.warnings, *session.warnings, *odd]
    if recording.reported:
        told.append(_compared(recording, stamps, chain, session))
    outcome = outcome_of(session.samples, stamps, joints, chain, more, config)
    calibration = pipeline.calibrate(recording.profiles, corrected(recording, outcome.arm), config)
    both = covering(calibration.covariance, outcome.covariance[:6, :6])
    return answer_of(outcome, replace(calibration, covariance=both), recording.inputs, told)


def corrected(recording: JointRecording, arm: Arm) -> list[TimedPose]:
    """Return the flange poses of a corrected arm at the joint values of a recording."""
    T = arm.forward(recording.joints)
    return [replace(pose, translation=own[:3, 3], quaternion=q) for pose, own, q in zip(
        recording.poses, T, se3.quaternion(T), strict=True)]


def _compared(recording: JointRecording, stamps: NDArray[np.int64], chain: Chain,
              session: Session) -> str:
    """Return in words how the controller's poses differ from those of the URDF, at samples."""
    reported = np.array([pose.stamp for pose in recording.reported])
    times, first = np.unique(reported - reported[0], return_index=True)
    at = np.array([sample.stamp for sample in session.samples])
    at = at[(at >= reported[0]) & (at <= reported[-1])]
    if len(times) < 2 or not len(at):
        return 'the reported poses are of another time than the profiles, and are not compared'
    poses = [recording.reported[i] for i in first]
    T = se3.interpolated(times.astype(float), np.array([p.translation for p in poses]),
                         np.array([p.quaternion for p in poses]),
                         (at - reported[0]).astype(float))
    return compared(T, chain.forward(at_stamps(at.tolist(), stamps, recording.joints)))


def solve_samples(samples: Sequence[Sample], rejects: Sequence[Reject], frame_id: str,
                  stamps: NDArray[np.int64], joints: Array, chain: Chain, config: Config
                  ) -> Answer:
    """Return the corrected arm from samples of stops; see outcome_of. Raises DataError."""
    outcome = outcome_of(samples, stamps, joints, chain, (), config)
    T = outcome.arm.forward(at_stamps([sample.stamp for sample in samples], stamps, joints))
    stops = [replace(sample, T_base_flange=own, motion=None)
             for sample, own in zip(samples, T, strict=True)]
    calibration = pipeline.solve(stops, rejects, config, frame_id)
    both = covering(calibration.covariance, outcome.covariance[:6, :6])
    return answer_of(outcome, replace(calibration, covariance=both),
                     [{'topic': config.profile_topic}, {'topic': config.joint_topic}], ())


def outcome_of(samples: Sequence[Sample], stamps: NDArray[np.int64], joints: Array,
               chain: Chain, more: Sequence[str], config: Config) -> Outcome:
    """
    Return the corrected arm, from samples of a robot that stops or moves.

    samples: their poses are those of the arm as stated, at joint values (n, joints) of stamps
    (n,). Raises DataError.
    """
    if len(samples) < MINIMUM:
        raise TooFewConfigurationsError(len(samples), MINIMUM)
    ordered, _ = consistent_edges(sorted(samples, key=lambda sample: sample.stamp))
    ordered = synchronised(ordered, config).samples
    q = at_stamps([sample.stamp + round(sample.offsets[0] * 1e9) for sample in ordered], stamps,
                  joints)
    method, arm = targets.method_for(config), Arm(chain)
    problem = Problem(method, in_mount(arm.forward(q), config),
                      method.features.observe(ordered), config)
    data, state = profiles_of(problem, q, arm)
    return solve(fit_of(data, state), more, config.limits.residual, lambda: DEFAULT_CAUSE)


def at_stamps(at: Sequence[int], stamps: NDArray[np.int64], joints: Array) -> Array:
    """Return joint values (k, joints) at some stamps, between those (n, joints) of stamps (n,)."""
    times, first = np.unique(stamps - stamps[0], return_index=True)
    spline = PchipInterpolator(times * 1e-9, joints[first])
    return np.asarray(spline(np.clip(np.array(at) - stamps[0], times[0], times[-1]) * 1e-9))


def compared(reported: Array, nominal: Array) -> str:
    """Return in words how reported poses (n, 4, 4) differ from those of the URDF."""
    off = np.linalg.norm(reported[:, :3, 3] - nominal[:, :3, 3], axis=1)
    turn = se3.angle(reported[:, :3, :3] @ np.swapaxes(nominal[:, :3, :3], 1, 2))
    if off.max() > OTHER_FRAMES or turn.max() > OTHER_FRAMES:
        return ('the reported poses are of other frames than base and flange of the URDF, and are '
                'not compared; the joint values are used')
    if off.max() < EQUAL:
        return 'the controller and the URDF have the same kinematics'
    return (f'the controller does not have the kinematics of the URDF: its poses differ by '
            f'{np.sqrt((off ** 2).mean()) * 1e3:.2f} mm RMS, {off.max() * 1e3:.2f} mm at most; '
            'the joint values are used')
