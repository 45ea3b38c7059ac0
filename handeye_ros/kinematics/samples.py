"""The corrected arm from samples of profiles: its joint values, and the answer of the pipeline."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from handeye_ros import pipeline, se3, targets
from handeye_ros.config import Config
from handeye_ros.data import AnyProfile, Array, Calibration, TimedPose
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
import numpy as np
from numpy.typing import NDArray

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
    joints = recording.joints
    odd = judged_joints(chain, {joint.follows: column for joint, column in zip(
        chain.joints, joints.T, strict=True) if joint.follows == joint.name})
    session = pipeline.gather(recording.profiles, recording.poses, config)
    q = at_stamps([sample.stamp for sample in session.samples], recording.poses, joints)
    told = [*recording.warnings, *session.warnings, *odd]
    if recording.reported:
        inside, poses = _poses_at([sample.stamp for sample in session.samples], recording.reported)
        told.append(compared(poses, chain.forward(q[inside])))
    outcome, calibration = solve_session(session, q, chain, more, config)
    return answer_of(outcome, calibration, recording.inputs, told)


def _poses_at(stamps: Sequence[int], poses: Sequence[TimedPose]
              ) -> tuple[NDArray[np.bool_], Array]:
    """Return which stamps lie between the poses, and the poses (k, 4, 4) there."""
    times = np.array([pose.stamp for pose in poses])
    at = np.array(stamps)
    inside = (at >= times[0]) & (at <= times[-1])
    after = np.minimum(np.searchsorted(times, at[inside]), len(times) - 1)
    near = [poses[i] for i in after]  # the robot stands still there
    return inside, se3.from_quaternion(np.array([pose.translation for pose in near]),
                                       np.array([pose.quaternion for pose in near]))


def solve_session(session: Session, q: Array, chain: Chain, more: Sequence[str], config: Config
                  ) -> tuple[Outcome, Calibration]:
    """
    Return the corrected arm and the calibration that belongs to it.

    session: its poses are those of the arm as stated; q: (n, joints) at its samples. Raises
    DataError.
    """
    if len(session.samples) < MINIMUM:
        raise TooFewConfigurationsError(len(session.samples), MINIMUM)
    order = np.argsort([sample.stamp for sample in session.samples], kind='stable')
    samples, q = [session.samples[i] for i in order], q[order]
    ordered, _ = consistent_edges(samples)
    here = np.searchsorted([s.stamp for s in samples], [s.stamp for s in ordered])
    method, arm = targets.method_for(config), Arm(chain)
    problem = Problem(method, in_mount(arm.forward(q[here]), config),
                      method.features.observe(ordered), config)
    data, state = profiles_of(problem, q[here], arm)
    outcome = solve(fit_of(data, state), more, config.limits.residual, lambda: DEFAULT_CAUSE)
    T = outcome.arm.forward(q)
    corrected = [replace(sample, T_base_flange=pose)
                 for sample, pose in zip(samples, T, strict=True)]
    calibration = pipeline.solve(corrected, session.rejects, config, session.frame_id)
    both = covering(calibration.covariance, outcome.covariance[:6, :6])
    return outcome, replace(calibration, covariance=both)


def at_stamps(stamps: Sequence[int], table: Sequence[TimedPose], joints: Array) -> Array:
    """Return joint values (n, joints) at stamps, between those of a table of poses."""
    times = np.array([pose.stamp for pose in table], dtype=np.int64)
    first = int(times[0])
    return np.column_stack([np.interp(np.array(stamps) - first, times - first, column)
                            for column in joints.T])


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
