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
from handeye_ros.estimation.solve import Solution, solution_at
from handeye_ros.guidance.advice import (
    Advice,
    advise,
    CAUSES_BY_BLOCK,
    enough_and_why,
    ROUGHLY_KNOWN,
)
from handeye_ros.guidance.candidates import (
    anchor_of,
    covariances_with_one_more,
    REFUSED_DISTANCE,
)
from handeye_ros.guidance.view import learn_view, next_move
from handeye_ros.pipeline import Answer
from handeye_ros.simulate import SCENARIOS
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

FEW = {'plate': (4, 4), 'line': (9, 0), 'plane': (8, 0), 'sphere': (7, 0), 'wedge': (8, 0)}
every_target = pytest.mark.parametrize('target', FEW)


@pytest.fixture(scope='module', params=FEW)
def few(request: pytest.FixtureRequest) -> tuple[Cell, Solution]:
    """Return a cell with few samples of each target, and the fit to them."""
    scenario = replace(SCENARIOS[request.param], stations=FEW[request.param])
    simulated = cell(scenario, 1)
    return simulated, solved(simulated.problem)


def answer(simulated: Cell, solution: Solution, refusal: DataError | None = None) -> Answer:
    return Answer(simulated.samples, solution, True, None, refusal)


def advice(few: tuple[Cell, Solution], failed_poses: tuple[Array, ...] = (),
           refusal: DataError | None = None, **values: object) -> Advice:
    """Return the advice after the samples of a cell; values: settings, __ for the dot."""
    simulated, solution = few
    return advise(simulated.samples, set_to(simulated.config, **values),
                  answer(simulated, solution, refusal), failed_poses=failed_poses)


def test_the_feature_stays_in_view_where_it_is_said_to_be(few: tuple[Cell, Solution]) -> None:
    proposal = advice(few).next
    assert proposal is not None
    simulated, solution = few
    view = learn_view(simulated.samples)
    assert view.room(proposal.place) > 0
    # the place is on the target: some spot that was seen before is there again, or beside it
    poses = [proposal.T_base_flange, *(s.T_base_flange for s in simulated.samples)]
    places = [proposal.place,
              *(anchor_of(solution.problem, i) for i in range(len(simulated.samples)))]
    there, *spots = (se3.apply(T @ solution.estimate.X, np.insert(place, 1, 0.0))
                     for T, place in zip(poses, places, strict=True))
    assert min(np.linalg.norm(spot - there) for spot in spots) < 0.25 * view.size[0]
    # and the face is looked at from above
    T = se3.inverse(simulated.truth.T_base_target) @ proposal.T_base_flange
    T_target_sensor = T @ simulated.truth.T_flange_sensor
    if simulated.scenario.scene in ('plate', 'line', 'plane'):
        assert T_target_sensor[2, 3] > 0 and T_target_sensor[2, 2] < -0.5


def test_what_a_sample_brings_is_what_the_solver_then_says(few: tuple[Cell, Solution]) -> None:
    _, solution = few
    observations, last = solution.problem.observations, len(solution.problem.poses) - 1
    fewer = replace(solution.problem,
                    observations=observations.select(observations.station != last))
    before = solution_at(fewer, solution.linear.estimate, solution.noise)
    after = covariances_with_one_more(before, solution.problem.subset(np.array([last])))[0]
    np.testing.assert_allclose(after, solution.covariance[:6, :6], rtol=1e-5, atol=1e-15)


def test_the_limits_are_kept(few: tuple[Cell, Solution]) -> None:
    simulated, solution = few
    proposal = advice(few, guidance__reach=0.15, guidance__tilt=0.3, guidance__turn=0.8).next
    assert proposal is not None
    first, T = simulated.samples[0].T_base_flange, proposal.T_base_flange
    assert np.linalg.norm(T[:3, 3] - first[:3, 3]) <= 0.15
    R_first, R = ((pose @ solution.estimate.X)[:3, :3] for pose in (first, T))
    assert np.arccos(R_first[:, 2] @ R[:, 2]) <= 0.3 + 1e-9
    turns, tilts = BENCH.turn_and_tilt(R_first, R[None])
    assert abs(turns[0]) <= 0.8 and np.linalg.norm(tilts) <= 0.3 + 1e-9


def test_limits_that_allow_nothing_are_reported(few: tuple[Cell, Solution]) -> None:
    result = advice(few, guidance__reach=0.0, guidance__accuracy=1e-6)
    assert result.next is None and not result.enough
    assert 'widen them' in result.text


def test_a_pose_at_which_nothing_was_taken_is_not_proposed_again(few):
    first = advice(few).next
    assert first is not None
    other = advice(few, failed_poses=(first.T_base_flange,)).next
    assert other is not None
    T = se3.inverse(first.T_base_flange) @ other.T_base_flange
    assert (np.linalg.norm(T[:3, 3]) > REFUSED_DISTANCE[0]
            or se3.angle(T[:3, :3]) > REFUSED_DISTANCE[1])


def test_it_is_the_same_in_another_base(few: tuple[Cell, Solution]) -> None:
    simulated, _ = few
    moved = replace(simulated, samples=tuple(
        replace(s, T_base_flange=ANY_POSE @ s.T_base_flange) for s in simulated.samples))
    here, there = advice(few).next, advice((moved, solved(moved.problem))).next
    assert here and there
    np.testing.assert_allclose(there.std, here.std, rtol=1e-3)


def test_eye_on_base_is_advised_too() -> None:
    simulated = cell(replace(SCENARIOS['eye_on_base'], stations=(4, 4)), 1)
    result = advice((simulated, solved(simulated.problem)))
    assert result.next
    first = simulated.samples[0].T_base_flange
    assert np.linalg.norm(result.next.T_base_flange[:3, 3] - first[:3, 3]) <= (
        simulated.config.guidance.reach)


def test_enough_is_said_with_its_reason(few: tuple[Cell, Solution]) -> None:
    generous = advice(few, guidance__accuracy=0.05)
    assert generous.enough
    assert generous.why.startswith('enough: points in view are known to ')
    strict = advice(few, guidance__accuracy=1e-6)
    assert not strict.enough
    assert strict.sigmas[-1].std > strict.sigmas[-1].limit == 1e-6


def test_the_words_lead_from_the_last_sample_to_the_pose(few: tuple[Cell, Solution]) -> None:
    result = advice(few, guidance__accuracy=1e-6)
    words, last = result.sentences[-1], few[0].samples[-1].T_base_flange
    assert result.next is not None
    turn, moved = np.eye(3), re.search('move by (.*?) mm along base x, y, z', words)
    for degrees, axis in re.findall(r'([+-]\d+) degrees about flange ([xyz])', words):
        turn = turn @ Rotation.from_euler(axis, int(degrees), degrees=True).as_matrix()
    off = se3.difference(result.next.T_base_flange, se3.transform(last[:3, :3] @ turn, last[:3, 3]
                         + 1e-3 * np.array(moved[1].split(', '), dtype=float)))
    assert np.abs(off).max() < 0.02, 'mm and degrees are whole ones'


def test_samples_whose_answer_is_refused_are_never_enough(few: tuple[Cell, Solution]) -> None:
    result = advice(few, refusal=DataError('only 2 samples show an edge'),
                    guidance__accuracy=0.05)
    assert not result.enough and result.why == 'only 2 samples show an edge'
    assert result.next


def test_a_sweep_goes_on_until_it_is_enough(few: tuple[Cell, Solution]) -> None:
    result = advice(few, guidance__accuracy=1e-6, sampling__mode='moving')
    assert not result.enough and result.next is None
    assert 'continue to sweep over' in result.sentences[-1]


@every_target
@pytest.mark.parametrize('turn', [0.1, 0.9, 1.75])
def test_before_there_is_an_answer_it_tells_moves_within_the_limits(target, turn):
    simulated = cell(target, 2)
    config = with_values(simulated.config, {'guidance.turn': turn}, 'test')
    method, view = targets.target_for(config), learn_view(simulated.samples)
    first = advise(simulated.samples[:1], config, Answer((), None, False, None, None))
    assert first.next is None and first.move is not None and not first.enough
    assert 'turn the sensor' in first.text and 'in view' in first.text
    assert ('beside the top' in first.text) == (target == 'sphere')
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
    result = advise((), cell('plate', 0).config)
    assert result.text.startswith('Take the first sample: hold the sensor square to the target')
    assert not result.enough


def test_a_sensor_that_is_not_roughly_known_is_not_aimed(few: tuple[Cell, Solution]) -> None:
    simulated, solution = few
    vague = replace(solution, report=solution,
                    added_covariances={'a test': ROUGHLY_KNOWN ** 2 * 2 * np.eye(6)})
    result = advice((simulated, vague))
    assert result.next is None and result.move is not None


def test_the_view_holds_what_was_seen() -> None:
    simulated = cell('plate', 0)
    view, inner = learn_view(simulated.samples), learn_view(simulated.samples).inner()
    points = np.concatenate([simulated.problem.observations.points])
    assert (view.room(points) > -1e-12).all()
    assert (inner.offsets < view.offsets).all() and (inner.size < view.size).all()
    assert view.room(view.box[1] + view.size) < 0
    wider = learn_view(simulated.samples, np.array([[np.nan, 0.1], [1.0, 0.2]]))
    assert wider.box[1, 0] == 1.0


def test_what_limits_is_named_with_its_key_and_more_samples_are_not_asked_for() -> None:
    simulated = cell(replace(SCENARIOS['plate'], stations=(15, 15)), 2)
    config = with_values(simulated.config, {'guidance.accuracy': 1e-5, 'noise.robot_scale': 3e-3},
                         'test')
    samples = simulated.samples
    result = advise(samples, config, pipeline.answer_samples(samples, (), config))
    assert 'as configured (noise.robot_scale)' in result.why and result.enough


@pytest.mark.parametrize(('count', 'gain', 'enough'), [
    (15, 0.01, True), (15, 0.03, False), (14, 0.01, False)])
def test_more_samples_that_bring_little_are_not_asked_for(count, gain, enough):
    cause = (CAUSES_BY_BLOCK['robot_smooth'], 0.875)
    simulated, why = enough_and_why(4e-4, 3e-4, 4e-4 * (1 - gain), cause, count)
    assert simulated == enough
    assert 'known to 0.400 mm' in why and '0.350 mm is the robot' in why
    assert ('more samples bring little, a better robot' in why) == enough
    _, why = enough_and_why(4e-4, 3e-4, 4e-4 * (1 - gain), None, count)
    assert why.endswith('more samples bring little') == enough, 'several causes need not be noise'


BENCH = bench_of('guidance')
ROBOT = BENCH.ROBOTS['common']


@pytest.mark.thorough
@pytest.mark.parametrize('target', ['plate', 'line', 'sphere'])
def test_moves_tell_more_than_poses_at_random(target):
    def sigma(seed, operator):
        """Return how well points in view are known after the stations an answer needs + 1."""
        cell = BENCH.world(target, ROBOT, seed, BENCH.KNOWN)
        for _ in range(targets.target_for(cell.config).min_samples):
            BENCH.insist(cell, BENCH.advised(cell, None) if operator == 'advice'
                         else lambda: BENCH.anywhere(cell))
        solution = BENCH.solved(cell)
        return BENCH.sigma_of(solution, cell)

    simulated = np.array([[sigma(seed, operator) for operator in BENCH.OPERATORS]
                          for seed in range(3)])
    moves, random = np.median(simulated, axis=0)
    assert moves < 0.7 * random


@pytest.mark.thorough
@pytest.mark.parametrize('target', ['plate', 'line', 'sphere', 'wedge'])
def test_a_node_takes_a_sample_at_every_pose_that_is_proposed(target):
    assert not BENCH.followed(BENCH.world(target, ROBOT, 0, {}), 0.0, 16).why
