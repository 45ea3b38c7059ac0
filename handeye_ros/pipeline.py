# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
From profiles and poses to the hand-eye transform: the algorithm on one page.

`gather` turns a recording into samples (what each stop of the robot shows), `answer_samples` the
samples into an `Answer` in ten steps: a calibration, or a refusal. The command line, the node, the
review of samples, the guidance and the report all read that answer. A function or method
`require_...` raises a refusal where what it names is missing (DataError; InputError where an
argument or a setting is wrong); a method returns it otherwise. `with_...` returns its first
argument, or a value that holds it, with what it names, and may refuse too.
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from handeye_ros import targets
from handeye_ros.calibration import calibration_of
from handeye_ros.checks.causes import require_agreement, with_known_cause
from handeye_ros.checks.clocks import require_steady_clocks
from handeye_ros.checks.hypotheses import Explanation
from handeye_ros.checks.moved import with_possible_move
from handeye_ros.checks.refusals import (
    missing_motion,
    require_certain,
    require_distinct_frame,
    require_edges,
    require_features,
    require_no_half_turn_twin,
    require_predicted,
    require_rotations,
    require_samples,
    require_testable,
)
from handeye_ros.checks.stated_lengths import (
    require_one_scale,
    with_loosened_lengths_if_needed,
    with_unstated_measure_if_needed,
)
from handeye_ros.checks.surfaces import OtherSurfaceError
from handeye_ros.config import Config
from handeye_ros.data import (
    AnyProfile,
    Calibration,
    Profile,
    QUATERNION_TOLERANCE,
    RawProfile,
    Reject,
    Sample,
    SEED,
    TimedPose,
)
from handeye_ros.errors import DataError, InputError, require_each, require_type
from handeye_ros.estimation.arm_errors import with_arm_errors
from handeye_ros.estimation.search import refined_solution, robust_solution
from handeye_ros.estimation.solution import Solution
from handeye_ros.frames import mount_frame, mount_poses_of
from handeye_ros.results.kinematics_file import read_arm
from handeye_ros.sampling.edge_shapes import with_common_edge_shape
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.sweep import with_estimated_clocks
from handeye_ros.targets.profile_target import ProfileTarget
from handeye_ros.threads import single_threaded
import numpy as np


@dataclass(frozen=True, eq=False)
class Answer:
    """
    What samples say: a calibration, or a refusal.

    samples: in the order of the stations that were solved, for a sweep with the poses at the
        estimated time offset
    solution: the last one, however uncertain; None where the steps ended before the first
    samples_agree: whether the samples agree with the solution (steps 6 and 7)
    calibration: None where it is refused
    refusal: why, None where there is a calibration
    """

    samples: Sequence[Sample]
    solution: Solution | None
    samples_agree: bool
    calibration: Calibration | None
    refusal: DataError | None

    def require_calibration(self) -> Calibration:
        """Return the calibration; raises the refusal."""
        if self.calibration is None:
            assert self.refusal is not None
            raise self.refusal
        return self.calibration

    def require_solution(self) -> Solution:
        """Return the solution, however uncertain; raises the refusal of steps 1 to 7."""
        if self.solution is None or not self.samples_agree:
            assert self.refusal is not None
            raise self.refusal
        return self.solution


def calibrate(profiles: Iterable[AnyProfile], poses: Iterable[TimedPose], config: Config
              ) -> Calibration:
    """
    Return the calibration from a recording, its messages in the order of their stamps.

    Raises DataError when the recording cannot carry an answer, and InputError as gather and
    answer_samples do.
    """
    return calibrate_session(gather(profiles, poses, config), config)


@single_threaded
def gather(profiles: Iterable[AnyProfile], poses: Iterable[TimedPose], config: Config) -> Session:
    """
    Return the samples and rejects of a recording, its messages in the order of their stamps.

    Raises DataError when it holds no stops, InputError for other arguments, for numbers that are
    no pose, and for messages that contradict the settings.
    """
    require_type('config', config, Config)
    session = Session(config)
    for pose in require_each('poses', poses, TimedPose):
        pose.require_values()
        session.add_pose(pose)
    for profile in require_each('profiles', profiles, Profile, RawProfile):
        session.add_profile(profile)
    session.evaluate_remaining()
    session.require_any_stop()
    return session


def calibrate_session(session: Session, config: Config) -> Calibration:
    """Return the calibration from what gather returns; raises as calibrate does."""
    return answer_session(session, config).require_calibration()


def answer_session(session: Session, config: Config) -> Answer:
    """
    Return the answer of a session.

    Raises DataError when it holds no stops, InputError for messages that contradict the settings,
    and as answer_samples does. config: the one of the session, which made its samples.
    """
    session.require_any_stop()
    return answer_samples(session.samples, session.rejects, session.config_with_base_frame(config),
                          session.frame_id, session)


def solve(samples: Sequence[Sample], rejects: Sequence[Reject], config: Config, frame_id: str
          ) -> Calibration:
    """
    Return the calibration from samples, in any order.

    rejects: stops that gave no sample, for the report; frame_id: of the profiles.
    Raises DataError when the samples cannot carry an answer, InputError for other arguments, and
    as answer_samples does.
    """
    require_type('config', config, Config)
    require_type('frame_id', frame_id, str)
    samples = [*require_each('samples', samples, Sample)]
    _require_values(samples, targets.target_for(config))
    rejects = [*require_each('rejects', rejects, Reject)]
    return answer_samples(samples, rejects, config, frame_id).require_calibration()


def _require_values(samples: Sequence[Sample], target: ProfileTarget) -> None:
    """Raise InputError for two samples of one stamp, and for numbers that none can have."""
    if len({sample.stamp for sample in samples}) < len(samples):
        raise InputError('two samples have the same stamp: each stop has its own')
    for sample in samples:
        for station in sample.station_samples:
            T, seen = np.asarray(station.T_base_flange), target.observe([station])
            if not (T.shape == (4, 4) and np.isfinite(T).all() and np.linalg.det(T) > 0 and
                    np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < QUATERNION_TOLERANCE):
                raise InputError(f'T_base_flange of the sample of stamp {sample.stamp} is no '
                                 'rigid transform (4, 4)')
            if not (np.isfinite(seen.points).all() and np.isfinite(seen.error_root).all()):
                raise InputError(f'the sample of stamp {sample.stamp} has features that are not '
                                 'finite')


@single_threaded
def answer_samples(samples: Sequence[Sample], rejects: Sequence[Reject], config: Config,
                   frame_id: str = '', session: Session | None = None, warnings: Sequence[str] = ()
                   ) -> Answer:
    """
    Return what samples say, in any order; see solve.

    session: the stops they come from, in which the cause of a refusal is searched; warnings: of
    the recording, if no session is given. Raises InputError for a target or a method that does not
    exist, and for a kinematics.yaml (config.kinematics) that cannot be used.
    """
    samples = sorted(samples, key=lambda sample: sample.stamp)
    target, rng = targets.target_for(config), np.random.default_rng(SEED)
    solution, calibration, refusal, samples_agree = None, None, None, False
    baseline = Explanation(())  # how well the samples fit as configured: nothing is known yet
    try:
        # 1. Edges: move each edge point to where face and wall meet, by the rounding or bevel that
        # all stops have in common.
        samples = with_common_edge_shape(samples)
        # 2. Preconditions: refuse a sensor with the frame of the robot, samples that are few or of
        # another target, and poses that do not turn about two axes.
        require_distinct_frame(frame_id, config)
        require_samples(samples, rejects, target)
        require_features(samples, target)
        require_rotations(mount_poses_of(samples, config), mount_frame(config),
                          target.lost_with_one_axis)
        # 3. Synchronisation of a sweep: the time offset gives each profile its pose.
        synced = with_estimated_clocks(samples, config)
        samples, rejects = synced.samples, [*rejects, *synced.rejects]
        # 4. Robust estimate: linear starts, graduated non-convexity, outlier rejection.
        problem = synced.problem or targets.problem_of_known_poses(samples, config)
        solution = robust_solution(problem, rng, subsets=True, start=synced.estimate)
        # 5. Measure of the target: estimate it where only this makes the samples agree.
        solution = with_unstated_measure_if_needed(solution, problem, rng, synced.estimate)
        # 6. Consistency: refuse samples that contradict each other, or fit decisively better under
        # another assumption (a hypothesis), which the refusal names.
        baseline = Explanation.of_solutions([sample.stamp for sample in samples], solution)
        require_agreement(samples, solution, baseline)
        # 7. Refinement: least squares with all systematic errors as nuisance parameters, their
        # taus and the noise estimated; outlier rejection again; lengths of the target where they
        # are stated wrongly. Refuse clocks that jumped, and lengths that differ in scale.
        solution = with_loosened_lengths_if_needed(refined_solution(solution))
        require_steady_clocks(solution)
        require_one_scale(solution)
        samples_agree = True
        # 8. Uncertainty: add that of a corrected arm and of a possible move. Refuse a sure move,
        # or an answer that cannot be tested, has a twin turned by half, is too uncertain, or
        # ignores the edges seen.
        if config.kinematics:
            solution = with_arm_errors(solution, read_arm(Path(config.kinematics)))
        require_testable(solution)
        require_no_half_turn_twin(solution)
        solution, move_warning = with_possible_move(solution)
        require_certain(solution.transform_covariance, config,
                        move_warning or missing_motion(solution, config),
                        solution.posterior.linear.lever)
        require_edges(solution)
        # 9. Left-out residuals: refuse samples that the others do not predict. The figures of the
        # answer hold these residuals.
        candidate = calibration_of(
            samples, rejects, solution, config, frame_id,
            [*filter(None, [move_warning]), *(session.warnings if session else warnings)])
        require_predicted(candidate.quality.holdout_rms, candidate.quality.residual_rms,
                          config.limits.residual)
        calibration = candidate
    except DataError as error:
        # 10. Diagnosis of a refusal without a certain cause: do other settings or clocks explain
        # the stops? Stops that show another surface are not used, if the others carry an answer.
        refusal = with_known_cause(error, baseline, session, config) if session else error
    answer = Answer(samples, solution, samples_agree, calibration, refusal)
    if session and isinstance(refusal, OtherSurfaceError):
        others = _answer_without_stops(refusal, session, config)
        return others if others.calibration else answer
    return answer


def _answer_without_stops(not_of_target: OtherSurfaceError, session: Session, config: Config
                          ) -> Answer:
    """Return the answer of a session without the stops that do not show the target."""
    rejects = [Reject(stamp, f'shows {not_of_target.why}') for stamp in not_of_target.stamps]
    samples = [sample for sample in session.samples if sample.stamp not in not_of_target.stamps]
    return answer_samples(samples, [*session.rejects, *rejects], config, session.frame_id,
                          warnings=[*session.warnings, not_of_target.warning])
