# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The advice: it keeps the feature in view, within the limits, and adds what is missing."""
from __future__ import annotations

from dataclasses import replace

from cells import ANY_POSE, Cell, cell, problem, solved
from handeye_ros import pipeline, se3, targets
from handeye_ros.config import with_values
from handeye_ros.data import Array, Sample
from handeye_ros.estimation.problem import linearise
from handeye_ros.estimation.solve import Solution
from handeye_ros.guidance.advice import Advice, advise, judged, Proposal, ROUGHLY_KNOWN, Sigma
from handeye_ros.guidance.candidates import Search, templates, USEFUL
from handeye_ros.guidance.moves import design, next_move
from handeye_ros.guidance.rules import limits_of, twist_of, visited
from handeye_ros.guidance.score import Cause, learn_view, mapping, seen_points, with_rows
from handeye_ros.guidance.views import anchor_of
from handeye_ros.simulate import SCENARIOS
import numpy as np
import pytest

TARGETS = ('plate', 'line', 'plane', 'sphere', 'wedge')
FEW = {'plate': (4, 4), 'line': (9, 0), 'plane': (8, 0), 'sphere': (7, 0), 'wedge': (8, 0)}


@pytest.fixture(scope='module', params=TARGETS)
def made(request: pytest.FixtureRequest) -> tuple[Cell, Solution]:
    """Return a cell with few samples of each target, and the fit to them."""
    scenario = replace(SCENARIOS[request.param], stations=FEW[request.param])
    found = cell(scenario, 1)
    return found, solved(found.problem)


def advice(made: tuple[Cell, Solution], **values: object) -> Advice:
    found, solution = made
    dotted = {key.replace('__', '.'): value for key, value in values.items()}
    return advise(found.samples, with_values(found.config, dotted, 'test'), solution)


def search(made: tuple[Cell, Solution]) -> Search:
    found, solution = made
    view = learn_view(found.samples)
    poses = np.array([s.T_base_flange for s in found.samples])
    return Search(solution, view, limits_of(poses[0], found.config),
                  mapping(solution.estimate.X, view), visited(found.samples, (), found.config),
                  poses[-1])


def sensor_poses(found: Cell, T_base_flange: Array) -> Array:
    """Return the true T_target_sensor."""
    return (se3.inverse(found.truth.T_base_target) @ T_base_flange
            @ found.truth.T_flange_sensor)


def test_the_feature_stays_in_view_where_it_is_said_to_be(made: tuple[Cell, Solution]) -> None:
    proposal = advice(made).next
    assert proposal is not None
    found, solution = made
    view = learn_view(found.samples)
    assert view.room(proposal.place) > 0
    # the place is on the target: some spot that was seen before is there again, or beside it
    T = proposal.T_base_flange @ solution.estimate.X
    there = T[:3, [0, 2]] @ proposal.place + T[:3, 3]
    spots = [_carried(s, solution, anchor_of(solution.problem, i))
             for i, s in enumerate(found.samples)]
    width = view.inner().size[0]
    assert min(np.linalg.norm(spot - there) for spot in spots) < 0.25 * width


def _carried(sample: Sample, solution: Solution, point: Array) -> Array:
    T = sample.T_base_flange @ solution.estimate.X
    return np.asarray(T[:3, [0, 2]] @ point + T[:3, 3])


def test_it_helps_more_than_most_others(made: tuple[Cell, Solution]) -> None:
    found = search(made)
    rng = np.random.default_rng(5)
    drawn = found.draw(rng)
    variances = np.concatenate([part.variance for part in drawn])
    best = found.refined(drawn, rng)
    now = found.mapping.variance(made[1].covariance[:6, :6])
    assert now - best.variance.min() >= USEFUL * (now - variances.min())
    assert (variances < now).all(), 'no sample makes anything less known'
    # it is sought around the nearest of those that add half as much as the best of them
    near, start = found._nearest_useful(drawn)
    far = max(drawn, key=lambda part: now - part.variance.min())
    assert found._distance(near.poses)[start] < found._distance(far.poses)[far.best()]


def test_what_a_sample_brings_is_what_the_solver_then_says(made: tuple[Cell, Solution]) -> None:
    found, solution = made
    observations = solution.problem.observations
    stations = np.unique(observations.station)
    last = observations.station == stations[-1]
    rows = solution.columns[last][None]
    problem = solution.problem
    fewer = replace(problem, observations=observations.select(~last))
    before = Solution.at(linearise(fewer, solution.linear.estimate), solution.noise)
    after = with_rows(before, rows)[0]
    np.testing.assert_allclose(after, solution.covariance[:6, :6], rtol=1e-5, atol=1e-15)



def test_the_limits_are_kept(made: tuple[Cell, Solution]) -> None:
    found, solution = made
    proposal = advice(made, guidance__reach=0.15, guidance__tilt=0.2, guidance__turn=0.5).next
    if proposal is None:
        pytest.skip('no pose within such limits: it is said so, see the next test')
    first, T = found.samples[0].T_base_flange, proposal.T_base_flange
    assert np.linalg.norm(T[:3, 3] - first[:3, 3]) <= 0.15
    X = solution.estimate.X
    R_first, R = first[:3, :3] @ X[:3, :3], T[:3, :3] @ X[:3, :3]
    assert np.arccos(R_first[:, 2] @ R[:, 2]) <= 0.2 + 1e-9
    assert abs(twist_of(R_first, R[None])[0]) <= 0.5


def test_limits_that_allow_nothing_are_reported(made: tuple[Cell, Solution]) -> None:
    result = advice(made, guidance__reach=0.0, guidance__accuracy=1e-6)
    assert result.next is None
    assert 'widen them' in result.text
    assert not result.enough


def test_it_is_the_same_in_another_base(made: tuple[Cell, Solution]) -> None:
    found, solution = made
    moved = replace(found, samples=tuple(
        replace(s, T_base_flange=ANY_POSE @ s.T_base_flange) for s in found.samples))
    here = advice(made).next
    there = advice((moved, solved(moved.problem))).next
    assert here and there
    np.testing.assert_allclose(there.std, here.std, rtol=1e-3)


def test_eye_on_base_is_advised_too() -> None:
    scenario = replace(SCENARIOS['eye_on_base'], stations=(4, 4))
    found = cell(scenario, 1)
    result = advise(found.samples, found.config, solved(found.problem))
    assert result.next
    first = found.samples[0].T_base_flange
    assert np.linalg.norm(result.next.T_base_flange[:3, 3] - first[:3, 3]) <= (
        found.config.guidance.reach)


def test_enough_is_said_with_its_reason(made: tuple[Cell, Solution]) -> None:
    generous = advice(made, guidance__accuracy=0.05)
    assert generous.enough
    assert generous.why.startswith('enough: points in view are known to ')
    strict = advice(made, guidance__accuracy=1e-6)
    assert not strict.enough
    assert strict.sigmas[-1].std > strict.sigmas[-1].limit == 1e-6
    assert 'from the last sample: turn ' in strict.text


def test_a_limit_that_is_not_kept_is_not_enough(made: tuple[Cell, Solution]) -> None:
    result = advice(made, guidance__accuracy=0.05, limits__rotation=1e-7)
    assert not result.enough
    assert 'rotation about' in result.why and 'is uncertain by' in result.why


def test_trouble_is_never_enough(made: tuple[Cell, Solution]) -> None:
    found, solution = made
    result = advise(found.samples, with_values(found.config, {'guidance.accuracy': 0.05}, 'test'),
                    solution, trouble='samples and poses contradict each other')
    assert not result.enough
    assert result.sentences[0] == 'samples and poses contradict each other'


def tilted_once(found: Cell, axis: int) -> Cell:
    """Return the samples of a plane whose tilts about one axis of the sensor are tiny."""
    X = found.truth.T_flange_sensor
    first = found.samples[0].T_base_flange @ X
    samples = []
    for sample in found.samples:
        vector = se3.log_rotation(first[:3, :3].T @ (sample.T_base_flange @ X)[:3, :3])
        samples.append((sample, vector))
    order = np.argsort([abs(vector[axis]) for _, vector in samples])
    return replace(found, samples=tuple(samples[i][0] for i in sorted(order[:9])))


@pytest.mark.parametrize(('axis', 'words'), [
    (0, 'tilt about the laser line: '), (1, 'tilt about the normal of the light plane: ')])
def test_words_name_the_tilt_that_is_missing(axis: int, words: str) -> None:
    many = cell(replace(SCENARIOS['plane'], stations=(120, 0)), 3)
    found = tilted_once(many, axis)
    result = advise(found.samples, with_values(found.config, {'guidance.accuracy': 1e-6}, 'test'),
                    solved(problem(found.samples, found.config)))
    (said,) = [s for s in result.sentences if s.startswith(words)]
    assert 'to either side so far, 15 wanted' in said


@pytest.mark.parametrize('target', TARGETS)
def test_before_there_is_an_answer_it_tells_moves(target: str) -> None:
    found = cell(target, 2)
    first = advise(found.samples[:1], found.config, None)
    assert first.next is None and first.move is not None and not first.enough
    assert 'turn the sensor' in first.text and 'in view' in first.text
    method = targets.method_for(found.config)
    length = len(design(method))
    moves = [next_move(n, method, found.config, learn_view(found.samples))
             for n in range(1, 2 * length)]
    for move in moves:
        assert np.linalg.norm(move.tilt) <= found.config.guidance.tilt
        assert abs(move.turn) <= found.config.guidance.turn
    assert len({(m.turn, *m.tilt, *m.place) for m in moves}) > length
    edges = {m.edge for m in moves}
    assert edges == ({0, 1} if len(method.essential) > 1 else {0})


@pytest.mark.parametrize('target', TARGETS)
@pytest.mark.parametrize('turn', [0.1, 0.9, 1.75])
def test_no_move_leads_beyond_the_limits(target: str, turn: float) -> None:
    found = cell(target, 2)
    config = with_values(found.config, {'guidance.turn': turn}, 'test')
    for n in range(1, 20):
        move = next_move(n, targets.method_for(config), config, learn_view(found.samples))
        assert abs(move.turn) <= turn
        assert np.linalg.norm(move.tilt) <= config.guidance.tilt


def test_the_line_crosses_the_other_edge_steeply_enough() -> None:
    found = cell('plate', 2)
    method, angle = targets.method_for(found.config), found.config.sampling.min_crossing_angle
    for n in range(1, 20):
        move = next_move(n, method, found.config, learn_view(found.samples))
        from_square = abs(move.turn) if move.edge == 0 else np.pi / 2 - abs(move.turn)
        assert from_square < np.pi / 2 - angle - 0.2


def test_only_a_sphere_is_cut_beside_its_top() -> None:
    for target in TARGETS:
        found = cell(target, 2)
        method, view = targets.method_for(found.config), learn_view(found.samples)
        move = next_move(1, method, found.config, view)
        assert (move.beside != 0) == ('beside the top' in move.text) == (target == 'sphere')


def test_nothing_yet() -> None:
    result = advise((), cell('plate', 0).config, None)
    assert result.text.startswith('Take the first sample: hold the sensor square to the target')
    assert not result.enough


def test_a_sensor_that_is_not_roughly_known_is_not_aimed(made: tuple[Cell, Solution]) -> None:
    found, solution = made
    vague = replace(solution, conservative=solution,
                    contamination=ROUGHLY_KNOWN ** 2 * 2 * np.eye(6))
    result = advise(found.samples, found.config, vague)
    assert result.next is None and result.move is not None


def test_the_view_holds_what_was_seen() -> None:
    found = cell('plate', 0)
    view = learn_view(found.samples)
    for sample in found.samples:
        assert (view.room(seen_points(sample)) > -1e-12).all()
    inner = view.inner()
    assert (inner.offsets < view.offsets).all() and (inner.size < view.size).all()
    assert view.room(view.high + view.size) < 0
    wider = learn_view(found.samples, np.array([[np.nan, 0.1], [1.0, 0.2]]))
    assert wider.high[0] == 1.0


def test_every_edge_has_a_prototype() -> None:
    found = cell('plate', 0)
    solution = solved(found.problem)
    obs = solution.problem.observations
    kinds = {int(k) for i in templates(solution.problem) for k in obs.kind[obs.station == i]}
    assert kinds == set(map(int, np.unique(obs.kind)))


@pytest.mark.parametrize('made', ['plate', 'line', 'plane'], indirect=True)
def test_the_face_is_looked_at_from_above(made: tuple[Cell, Solution]) -> None:
    drawn = search(made).draw(np.random.default_rng(3))
    T_target_sensor = sensor_poses(made[0], np.concatenate([part.poses for part in drawn]))
    assert len(T_target_sensor) > 20
    assert (T_target_sensor[:, 2, 3] > 0).all()
    assert (T_target_sensor[:, 2, 2] < -0.5).all()


def test_an_edge_is_where_it_is_said_and_so_much_of_its_face_is_seen_that_it_is_found() -> None:
    found = cell(replace(SCENARIOS['line'], stations=FEW['line']), 1)
    searched = search((found, solved(found.problem)))
    view, seen = searched.view.inner(), 0
    for part in searched.draw(np.random.default_rng(5)):
        for pose, place in zip(part.poses, part.anchors, strict=True):
            T = sensor_poses(found, pose)
            edge = T[:3, [0, 2]] @ place + T[:3, 3]
            assert np.abs(edge[1:]).max() < 5e-3, 'the true edge is the x axis'
            along = np.cross([0.0, 0.0, 1.0], T[:3, 1])  # the face is z = 0, y > 0
            along = T[:3, [0, 2]].T @ (along * np.sign(along[1]))
            assert view.room(place + 0.15 * view.size[0] * along / np.linalg.norm(along)) > 0
            seen += 1
    assert seen > 10


def test_what_limits_is_named_with_its_key_and_more_samples_are_not_asked_for() -> None:
    found = cell('plate', 2)  # 18 samples
    config = with_values(found.config, {'guidance.accuracy': 1e-5, 'noise.robot_scale': 3e-3},
                         'test')
    solution = pipeline.answer(found.samples, (), config).consensus()
    result = advise(found.samples, config, solution)
    assert 'as configured (noise.robot_scale)' in result.why and result.enough


@pytest.mark.parametrize(('count', 'gain', 'enough'), [
    (15, 0.01, True), (15, 0.03, False), (14, 0.01, False)])
def test_more_samples_that_bring_little_are_not_asked_for(count: int, gain: float, enough: bool
                                                          ) -> None:
    sigmas = (Sigma('any', 0.0, 1.0), Sigma('worst', 0.0, 1.0), Sigma('points', 4e-4, 3e-4))
    next_one = Proposal(np.eye(4), np.zeros(2), 4e-4 * (1 - gain))
    cause = Cause("the robot's accuracy as configured", 'noise.robot_smooth', 3.5e-4)
    found, why = judged(sigmas, next_one, cause, count)
    assert found == enough
    assert '0.350 mm is the robot' in why
    assert ('more samples bring little, a better robot' in why) == enough
