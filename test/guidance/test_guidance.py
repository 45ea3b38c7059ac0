# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The advice: it keeps the feature in view, within the limits, and adds what is missing."""
from __future__ import annotations

from dataclasses import replace
import re

from cells import ANY_POSE, Cell, cell, set_to, solved
from command import bench_of
from handeye_ros import pipeline, se3, targets
from handeye_ros.config import with_values
from handeye_ros.data import Array
from handeye_ros.errors import DataError
from handeye_ros.estimation.posterior import posterior_at
from handeye_ros.estimation.search import refined_solution
from handeye_ros.estimation.solution import Solution
from handeye_ros.guidance.advice import (
    Advice,
    advise,
    enough_and_why,
    LIMITING_FACTORS,
    ROUGHLY_KNOWN,
)
from handeye_ros.guidance.candidates import (
    anchor_of,
    covariances_with_one_more,
    FAILED_POSE_DISTANCE,
)
from handeye_ros.guidance.first_moves import next_move
from handeye_ros.guidance.view import learn_view
from handeye_ros.pipeline import Answer
from handeye_ros.simulate import SCENARIOS
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

FEW = {'plate': (4, 4), 'line': (9, 0), 'plane': (8, 0), 'sphere': (7, 0), 'wedge': (8, 0)}


@pytest.fixture(scope='module', params=FEW)
def fitted(request: pytest.FixtureRequest) -> tuple[Cell, Solution]:
    """Return a cell with few samples of each target, and the fit to them."""
    scenario = replace(SCENARIOS[request.param], stops=FEW[request.param])
    simulated_cell = cell(scenario, 1)
    return simulated_cell, solved(simulated_cell.problem)


def advice_for(fitted: tuple[Cell, Solution], failed_poses: tuple[Array, ...] = (),
               refusal: DataError | None = None, **values: object) -> Advice:
    """Return the advice after the samples of a cell; values: settings, __ for the dot."""
    cell, solution = fitted
    return advise(cell.samples, set_to(cell.config, **values),
                  Answer(cell.samples, solution, True, None, refusal), failed_poses=failed_poses)


def test_the_feature_stays_in_view_where_it_is_said_to_be(fitted: tuple[Cell, Solution]) -> None:
    proposal = advice_for(fitted).next_pose
    assert proposal is not None
    simulated_cell, solution = fitted
    view = learn_view(simulated_cell.samples)
    assert view.room(proposal.place) > 0
    # the place is on the target: some spot that was seen before is there again, or beside it
    poses = [proposal.T_base_flange, *(s.T_base_flange for s in simulated_cell.samples)]
    places = [proposal.place,
              *(anchor_of(solution.problem, i) for i in range(len(simulated_cell.samples)))]
    spot_proposed, *spots = (se3.apply(T @ solution.estimate.X, np.insert(place, 1, 0.0))
                             for T, place in zip(poses, places, strict=True))
    assert min(np.linalg.norm(spot - spot_proposed) for spot in spots) < 0.25 * view.size[0]
    # and the face is looked at from above
    T = se3.inverse(simulated_cell.truth.T_base_target) @ proposal.T_base_flange
    T_target_sensor = T @ simulated_cell.truth.T_flange_sensor
    if simulated_cell.scenario.scene in ('plate', 'line', 'plane'):
        assert T_target_sensor[2, 3] > 0 and T_target_sensor[2, 2] < -0.5


def test_what_a_sample_brings_is_what_the_solver_then_says(fitted: tuple[Cell, Solution]) -> None:
    _, solution = fitted
    observations, last = solution.problem.observations, len(solution.problem.poses) - 1
    fewer = replace(solution.problem,
                    observations=observations.select(observations.station != last))
    posterior = posterior_at(fewer, solution.estimate, solution.posterior.noise)
    before = replace(solution, posterior=posterior, report_posterior=posterior)
    after = covariances_with_one_more(before, solution.problem.subset(np.array([last])))[0]
    np.testing.assert_allclose(after, solution.transform_covariance, rtol=1e-5, atol=1e-15)


def test_the_limits_are_kept(fitted: tuple[Cell, Solution]) -> None:
    simulated_cell, solution = fitted
    advice = advice_for(fitted, guidance__reach=0.15, guidance__tilt=0.3, guidance__turn=0.8)
    assert (proposal := advice.next_pose) is not None
    first, T = simulated_cell.samples[0].T_base_flange, proposal.T_base_flange
    assert np.linalg.norm(T[:3, 3] - first[:3, 3]) <= 0.15
    R_first, R = ((pose @ solution.estimate.X)[:3, :3] for pose in (first, T))
    assert np.arccos(R_first[:, 2] @ R[:, 2]) <= 0.3 + 1e-9
    turns, tilts = BENCH.turn_and_tilt(R_first, R[None])
    assert abs(turns[0]) <= 0.8 and np.linalg.norm(tilts) <= 0.3 + 1e-9


def test_limits_that_allow_nothing_are_reported(fitted: tuple[Cell, Solution]) -> None:
    advice = advice_for(fitted, guidance__reach=0.0, guidance__accuracy=1e-6)
    assert advice.next_pose is None
    assert not advice.enough
    assert 'widen them' in advice.text


def test_a_failed_pose_is_not_proposed_again(fitted: tuple[Cell, Solution]) -> None:
    proposal = advice_for(fitted).next_pose
    assert proposal is not None
    next_proposal = advice_for(fitted, failed_poses=(proposal.T_base_flange,)).next_pose
    assert next_proposal is not None
    T = se3.inverse(proposal.T_base_flange) @ next_proposal.T_base_flange
    assert (np.linalg.norm(T[:3, 3]) > FAILED_POSE_DISTANCE[0]
            or se3.angle(T[:3, :3]) > FAILED_POSE_DISTANCE[1])


def test_it_is_the_same_in_another_base(fitted: tuple[Cell, Solution]) -> None:
    simulated_cell, _ = fitted
    moved = replace(simulated_cell, samples=tuple(
        replace(s, T_base_flange=ANY_POSE @ s.T_base_flange) for s in simulated_cell.samples))
    advice, in_other_base = advice_for(fitted), advice_for((moved, solved(moved.problem)))
    assert advice.next_pose and in_other_base.next_pose
    np.testing.assert_allclose(in_other_base.next_pose.std, advice.next_pose.std, rtol=1e-3)


def test_eye_on_base_is_advised_too() -> None:
    simulated_cell = cell(replace(SCENARIOS['eye_on_base'], stops=(4, 4)), 1)
    advice = advice_for((simulated_cell, solved(simulated_cell.problem)))
    assert advice.next_pose
    T_first = simulated_cell.samples[0].T_base_flange
    assert np.linalg.norm(advice.next_pose.T_base_flange[:3, 3] - T_first[:3, 3]) <= (
        simulated_cell.config.guidance.reach)
    first = advise(simulated_cell.samples[:1], simulated_cell.config,
                   Answer((), None, False, None, None))
    assert 'turn the target' in first.text and 'turn the sensor' not in first.text


def test_enough_is_said_with_its_reason(fitted: tuple[Cell, Solution]) -> None:
    generous = advice_for(fitted, guidance__accuracy=0.05)
    assert generous.enough
    assert generous.why.startswith('enough: points in view are known to ')
    strict = advice_for(fitted, guidance__accuracy=1e-6)
    assert not strict.enough
    assert strict.sigmas[-1].std > strict.sigmas[-1].limit == 1e-6


def test_the_words_lead_from_the_last_sample_to_the_pose(fitted: tuple[Cell, Solution]) -> None:
    advice = advice_for(fitted, guidance__accuracy=1e-6)
    words, last = advice.sentences[-1], fitted[0].samples[-1].T_base_flange
    assert advice.next_pose is not None
    numbers = [np.array(match.split(', '), dtype=float)
               for match in re.findall(r'by ((?:[+-]\d+, ){2}[+-]\d+) ', words)]
    turn = Rotation.from_euler('XYZ', numbers[0], degrees=True).as_matrix()
    T = se3.transform(last[:3, :3] @ turn, last[:3, 3] + 1e-3 * numbers[1])
    error = se3.difference(advice.next_pose.T_base_flange, T)
    assert np.abs(error).max() < 0.02, 'mm and degrees are whole ones'


def test_samples_whose_answer_is_refused_are_never_enough(fitted: tuple[Cell, Solution]) -> None:
    advice = advice_for(fitted, refusal=DataError('only 2 samples show an edge'),
                        guidance__accuracy=0.05)
    assert advice.next_pose
    assert not advice.enough
    assert advice.why == 'only 2 samples show an edge'


def test_a_sweep_goes_on_until_it_is_enough(fitted: tuple[Cell, Solution]) -> None:
    advice = advice_for(fitted, guidance__accuracy=1e-6, sampling__mode='moving')
    assert not advice.enough and advice.next_pose is None
    assert 'continue to sweep over' in advice.sentences[-1]


@pytest.mark.parametrize('target', FEW)
@pytest.mark.parametrize('turn', [0.1, 0.9, 1.75])
def test_before_an_answer_it_tells_moves_within_the_limits(target: str, turn: float) -> None:
    simulated_cell = cell(target, 2)
    config = with_values(simulated_cell.config, {'guidance.turn': turn}, 'test')
    method, view = targets.target_for(config), learn_view(simulated_cell.samples)
    advice = advise(simulated_cell.samples[:1], config, Answer((), None, False, None, None))
    assert advice.next_pose is None and advice.move_from_first_pose and not advice.enough
    assert 'turn the sensor' in advice.text and 'in view' in advice.text
    assert ('beside the top' in advice.text) == (target == 'sphere')
    moves = [next_move(n, method, config, view) for n in range(1, 20)]
    for move in moves:
        assert np.linalg.norm(move.tilt) <= config.guidance.tilt and abs(move.turn) <= turn
        assert (move.beside == 0) or target == 'sphere'
        from_square = abs(move.turn) if move.edge == 0 else np.pi / 2 - abs(move.turn)
        if target == 'plate' and turn == 1.75:  # the line crosses the other edge steeply enough
            assert from_square < np.pi / 2 - config.sampling.min_crossing_angle - 0.2
    assert len({(m.turn, *m.tilt, *m.place) for m in moves}) > 6
    assert {m.edge for m in moves} == ({0, 1} if target == 'plate' else {0})


def test_before_the_first_sample_it_tells_how_to_take_it() -> None:
    advice = advise((), cell('plate', 0).config)
    assert advice.text.startswith('Take the first sample: hold the sensor square to the target')
    assert not advice.enough


def test_a_sensor_that_is_not_roughly_known_is_not_aimed(fitted: tuple[Cell, Solution]) -> None:
    simulated_cell, solution = fitted
    certain = refined_solution(solution)
    vague = replace(certain, report_posterior=certain.posterior,
                    added_covariances={'a test': ROUGHLY_KNOWN ** 2 * 2 * np.eye(6)})
    advice = advice_for((simulated_cell, vague))
    assert advice.next_pose is None and advice.move_from_first_pose is not None


def test_the_view_holds_what_was_seen() -> None:
    plate_cell = cell('plate', 0)
    view, inner = learn_view(plate_cell.samples), learn_view(plate_cell.samples).inner()
    points = np.concatenate([plate_cell.problem.observations.points])
    assert (view.room(points) > -1e-12).all()
    assert (inner.offsets < view.offsets).all() and (inner.size < view.size).all()
    assert view.room(view.box[1] + view.size) < 0
    wider = learn_view(plate_cell.samples, np.array([[np.nan, 0.1], [1.0, 0.2]]))
    assert wider.box[1, 0] == 1.0


def test_what_limits_is_named_with_its_key_and_is_enough() -> None:
    plate_cell = cell(replace(SCENARIOS['plate'], stops=(15, 15)), 2)
    config = with_values(plate_cell.config, {'guidance.accuracy': 1e-5, 'noise.robot_scale': 3e-3},
                         'test')
    samples = plate_cell.samples
    advice = advise(samples, config, pipeline.answer_samples(samples, (), config))
    assert 'as configured (noise.robot_scale)' in advice.why and advice.enough


@pytest.mark.parametrize(('count', 'gain', 'enough'), [
    (15, 0.01, True), (15, 0.03, False), (14, 0.01, False)])
def test_samples_of_little_use_are_not_asked_for(count: int, gain: float, enough: bool) -> None:
    cause = (LIMITING_FACTORS[0], 0.875)
    is_enough, why = enough_and_why(4e-4, 3e-4, 4e-4 * (1 - gain), cause, count)
    assert is_enough == enough
    assert 'known to 0.400 mm' in why and '0.350 mm is the robot' in why
    assert ('more samples bring little, a better robot' in why) == enough
    _, why = enough_and_why(4e-4, 3e-4, 4e-4 * (1 - gain), None, count)
    assert why.endswith('more samples bring little') == enough, 'several causes need not be noise'


BENCH = bench_of('guidance')
ROBOT = BENCH.ROBOTS['common']


@pytest.mark.thorough
@pytest.mark.parametrize('target', ['plate', 'line', 'sphere'])
def test_moves_tell_more_than_poses_at_random(target: str) -> None:
    def sigma(seed: int, operator: str) -> float:
        """Return how well points in view are known after the stations an answer needs + 1."""
        cell = BENCH.world(target, ROBOT, seed, BENCH.KNOWN)
        for _ in range(targets.target_for(cell.config).min_samples):
            BENCH.insist(cell, BENCH.advised(cell, None) if operator == 'advice'
                         else lambda: BENCH.anywhere(cell))
        return BENCH.sigma_of(BENCH.solved(cell), cell)

    moves, random = np.median([[sigma(seed, operator) for operator in BENCH.OPERATORS]
                               for seed in range(3)], axis=0)
    assert moves < 0.7 * random


@pytest.mark.thorough
@pytest.mark.parametrize('target', ['plate', 'line', 'sphere', 'wedge'])
def test_a_node_takes_a_sample_at_every_pose_that_is_proposed(target: str) -> None:
    assert not BENCH.followed(BENCH.world(target, ROBOT, 0, {}), 0.0, 16).why
