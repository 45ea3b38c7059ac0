# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
From profiles and poses to the hand-eye transform: the whole way.

`gather` turns a recording into samples, `answer_samples` the samples into a calibration or a
refusal. The command line, the node, the review of samples, the guidance and the report all read
that answer.
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from handeye_ros import targets
from handeye_ros.arm import with_arm_errors
from handeye_ros.calibration import calibration_of
from handeye_ros.checks.causes import require_agreement, with_known_cause
from handeye_ros.checks.clocks import require_steady_clocks
from handeye_ros.checks.hypotheses import Fit
from handeye_ros.checks.moved import with_possible_move
from handeye_ros.checks.refusals import (
    missing_motion,
    require_certain,
    require_distinct_frame,
    require_edges,
    require_left_out,
    require_no_half_turn_twin,
    require_rotations,
    require_samples,
    require_tested,
)
from handeye_ros.checks.stated_lengths import (
    require_one_scale,
    with_free_shape_if_needed,
    with_free_size_if_needed,
)
from handeye_ros.checks.surfaces import NotOfTargetError
from handeye_ros.config import Config
from handeye_ros.data import (
    AnyProfile,
    Calibration,
    Profile,
    RawProfile,
    Reject,
    require_each,
    Sample,
    TimedPose,
)
from handeye_ros.errors import DataError, require_type
from handeye_ros.estimation.least_squares import single_threaded
from handeye_ros.estimation.search import robust_solution, with_systematic_errors
from handeye_ros.estimation.solve import Solution
from handeye_ros.frames import mount_frame, mount_poses_of
from handeye_ros.sampling.edge_shapes import with_common_shape
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.sweep import problem_of_known_poses, with_estimated_clocks
import numpy as np

SEED = 0  # of the random searches: the same samples give the same answer


@dataclass(frozen=True, eq=False)
class Answer:
    """
    What samples say: a calibration, or a refusal.

    samples: in the order of the stations that were solved, for a sweep with the poses at the
        estimated time offset
    solution: of those that agree, however uncertain, None where none can be started
    samples_agree: whether the samples agree with it
    calibration: None where it is refused
    refusal: why, None where it is not
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
        """Return the solution, however uncertain; raises DataError where samples contradict it."""
        if self.solution is None or not self.samples_agree:
            assert self.refusal is not None
            raise self.refusal
        return self.solution


def calibrate(profiles: Iterable[AnyProfile], poses: Iterable[TimedPose], config: Config
              ) -> Calibration:
    """
    Return the calibration from a recording, its messages in the order of their stamps.

    Raises DataError when the recording cannot carry an answer.
    """
    return calibrate_session(gather(profiles, poses, config), config)


@single_threaded
def gather(profiles: Iterable[AnyProfile], poses: Iterable[TimedPose], config: Config) -> Session:
    """
    Return the samples and rejects of a recording, its messages in the order of their stamps.

    Raises DataError when it holds no stops, InputError for other arguments, and for numbers that
    are no pose.
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
    """Return the calibration from what gather returns; raises DataError as calibrate does."""
    return answer_session(session, config).require_calibration()


def answer_session(session: Session, config: Config) -> Answer:
    """Return the answer of a session; raises DataError when it holds no stops."""
    session.require_any_stop()
    return answer_samples(session.samples, session.rejects, session.with_base(config),
                          session.frame_id, session)


def solve(samples: Sequence[Sample], rejects: Sequence[Reject], config: Config, frame_id: str
          ) -> Calibration:
    """
    Return the calibration from samples, in any order.

    rejects: stops that gave no sample, for the report; frame_id: of the profiles.
    Raises DataError when the samples cannot carry an answer, InputError for other arguments.
    """
    require_type('config', config, Config)
    require_type('frame_id', frame_id, str)
    samples = [*require_each('samples', samples, Sample)]
    rejects = [*require_each('rejects', rejects, Reject)]
    return answer_samples(samples, rejects, config, frame_id).require_calibration()


@single_threaded
def answer_samples(samples: Sequence[Sample], rejects: Sequence[Reject], config: Config,
                   frame_id: str = '', session: Session | None = None, warnings: Sequence[str] = ()
                   ) -> Answer:
    """
    Return what samples say, in any order; see solve.

    session: the stops they come from, in which the cause of a refusal is searched; warnings: of
    the recording, if no session is given.
    """
    ordered: Sequence[Sample] = sorted(samples, key=lambda sample: sample.stamp)
    target, rng = targets.target_for(config), np.random.default_rng(SEED)
    solution, calibration, refusal, agree = None, None, None, False
    stated = Fit(())
    try:
        # 1. Move each edge to where face and wall meet, by the shape common to all stops.
        ordered = with_common_shape(ordered)
        # 2. Refuse what no solver can answer: the sensor's frame, too few samples, no rotation.
        require_distinct_frame(frame_id, config)
        require_samples(ordered, rejects, target)
        require_rotations(mount_poses_of(ordered, config), mount_frame(config), target.one_axis)
        # 3. Of a sweep, find the offset between the clocks: it gives each profile its pose.
        synced = with_estimated_clocks(ordered, config)
        ordered, rejects = synced.samples, [*rejects, *synced.rejects]
        # 4. Linear starts, graduated non-convexity, and outliers dropped one by one.
        problem = synced.problem or problem_of_known_poses(ordered, config)
        solution = robust_solution(problem, rng, subsets=True, start=synced.estimate)
        # 5. Estimate a stated shape of the target where only this makes the samples agree.
        solution = with_free_shape_if_needed(problem, solution, rng, synced.estimate)
        # 6. Refuse samples that do not agree, or agree far better under another assumption, and
        # name the assumption that is wrong, if it is certain.
        stated = Fit.of_solutions([sample.stamp for sample in ordered], solution)
        require_agreement(ordered, solution, stated)
        # 7. Estimate all systematic errors with their scales, and the noise; outliers again; the
        # lengths of the target where they are stated wrongly. Refuse clocks that jumped, and
        # scales that differ.
        solution = with_free_size_if_needed(with_systematic_errors(solution))
        require_steady_clocks(solution)
        require_one_scale(solution)
        agree = True
        if config.kinematics:  # a corrected arm, which has errors of its own
            solution = with_arm_errors(solution, Path(config.kinematics))
        # 8. Refuse an answer that cannot be tested, has a twin turned by half, is uncertain or
        # ignores what was seen.
        require_tested(solution)
        require_no_half_turn_twin(solution)
        solution, warning = with_possible_move(solution)  # a move makes the answer uncertain
        require_certain(solution.transform_covariance, config,
                        warning or missing_motion(solution, config), solution.linear.lever)
        require_edges(solution)
        # 9. Predict each sample from the others.
        warnings = session.warnings if session else warnings
        assembled = calibration_of(ordered, rejects, solution, config, frame_id,
                                   [*filter(None, [warning]), *warnings])
        require_left_out(assembled.quality.holdout_rms, assembled.quality.residual_rms,
                         config.limits.residual)
        calibration = assembled
    except DataError as error:
        # 10. Without a certain cause, ask whether other settings or clocks explain the stops;
        # those that show another surface are left out.
        refusal = with_known_cause(error, stated, session, config) if session else error
        if session and isinstance(refusal, NotOfTargetError):
            others = _answer_without(refusal, session, config)
            if others.calibration:
                return others
    return Answer(ordered, solution, agree, calibration, refusal)


def _answer_without(found: NotOfTargetError, session: Session, config: Config) -> Answer:
    """Return the answer from the stops of a session that do not show another surface."""
    rejects = [Reject(stamp, f'shows {found.why}') for stamp in found.stamps]
    others = [sample for sample in session.samples if sample.stamp not in found.stamps]
    return answer_samples(others, [*session.rejects, *rejects], config, session.frame_id,
                          warnings=[*session.warnings, found.warning])
