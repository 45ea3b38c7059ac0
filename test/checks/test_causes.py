# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Wrong conventions, what moved and what is clamped over the target are named."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
import re
from types import SimpleNamespace

from cells import Cell, cell, ONE_IN_100, refused, settings_of, squared_error
from handeye_ros import pipeline, se3
from handeye_ros.checks.conventions import orientations_scatter
from handeye_ros.checks.moved import outliers_at_one_end
from handeye_ros.config import Config, flipped_range
from handeye_ros.data import Array, FaceLine, Sample
from handeye_ros.errors import DataError
from handeye_ros.estimation.least_squares import chi2_isf
from handeye_ros.guidance.advice import advise
from handeye_ros.simulate import (
    FAULTS,
    Scenario,
    SCENARIOS,
    scenes,
    simulate,
    simulate_samples,
)
from handeye_ros.simulate.robot import CONVENTION_ERRORS as SIMULATED
from handeye_ros.simulate.solids import box, Solid
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from streams import in_order

Change = Callable[[Array], Array]  # of poses


def with_poses(cell: Cell, change: Change) -> list[Sample]:
    poses = change(np.array([s.T_base_flange for s in cell.samples]))
    return [replace(s, T_base_flange=T) for s, T in zip(cell.samples, poses, strict=True)]


def simulated(error: str) -> Change:
    """Return what the simulator makes of poses with this error."""
    return lambda T: se3.from_quaternion(*SIMULATED[error](T[:, :3, 3], se3.quaternion(T)))


def read(change: Callable[[Rotation], Rotation]) -> Change:
    """Return what poses become whose orientations are read wrongly."""
    return lambda T: se3.transform(change(Rotation.from_matrix(T[:, :3, :3])).as_matrix(),
                                   T[:, :3, 3])


def angles(values: Array) -> Rotation:
    """Return orientations of roll, pitch, yaw."""
    return Rotation.from_euler('xyz', values)


@pytest.mark.parametrize(('target', 'change', 'words'), [
    ('plate', simulated('inverted'), 'inverse poses'),
    ('sphere', simulated('inverted'), 'inverse poses'),
    ('plate', simulated('wxyz'), 'w x y z'), ('plate', simulated('intrinsic'), 'intrinsic'),
    ('plate', simulated('millimetres'), 'positions in millimetres'),
    *(('plate', read(change), words) for change, words in (
        (lambda R: R.inv(), 'transposed rotations'),
        (lambda R: angles(np.radians(R.as_euler('xyz'))), 'angles in radians'),
        (lambda R: angles(R.as_euler('XYZ')), 'intrinsic Euler angles'),
        (lambda R: angles(R.as_euler('xyz')[:, [2, 1, 0]]), 'roll and yaw exchanged'),
        (lambda R: angles(R.as_rotvec()), 'with rotation vectors'))),
    ('plate', simulated('degrees'), 'angles in degrees are read as radians'),
    ('sphere', simulated('degrees'), 'angles in degrees are read as radians')])
def test_convention_errors_are_named(target: str, change: Change, words: str) -> None:
    simulated_cell = cell(target, 1)
    with refused('convention', words):
        simulated_cell.solve(with_poses(simulated_cell, change))
    assert not orientations_scatter(simulated_cell.problem.poses)


@pytest.mark.thorough
def test_convention_errors_are_named_in_a_sweep_whose_clocks_differ() -> None:
    sweep = SCENARIOS['plane_sweep']
    sweep = replace(sweep, sensor=replace(sweep.sensor, rate=10.0, columns=320, delay=-0.02))
    recording = simulate(sweep, np.random.default_rng(1))
    T = se3.inverse(np.array([se3.from_quaternion(p.translation, p.quaternion)
                              for p in recording.poses]))
    poses = [replace(p, translation=translation, quaternion=q) for p, translation, q in zip(
        recording.poses, T[:, :3, 3], se3.quaternion(T), strict=True)]
    with pytest.raises(DataError, match='inverse poses undone, .* profiles fit'):
        pipeline.calibrate(recording.profiles, poses, settings_of(sweep, sampling__mode='moving'))


@pytest.mark.parametrize('name', ['plate_real_robot', 'sphere_real_robot'])
def test_a_robot_worse_than_stated_is_no_convention_error(name: str) -> None:
    for seed in range(2):
        assert cell(name, seed).solve()


@pytest.mark.parametrize('target', ['plate', 'sphere', 'line', 'plane'])
@pytest.mark.parametrize('true_type', ['eye_in_hand', 'eye_on_base'])
def test_the_wrong_calibration_type_names_the_key(target: str, true_type: str) -> None:
    wrong_type = 'eye_on_base' if true_type == 'eye_in_hand' else 'eye_in_hand'
    simulated_cell = cell(replace(SCENARIOS[target], calibration_type=true_type), 1)
    with pytest.raises(DataError, match=f'with calibration_type {true_type} or inverse'):
        simulated_cell.solve(calibration_type=wrong_type)


@pytest.mark.parametrize(('seed', 'wrong_poses'), [
    (1, lambda T: np.array([s.T_base_flange for s in cell('plate', 2).samples])),
    (3, lambda T: np.roll(T, 1, axis=0))], ids=['of another recording', 'of another sample'])
def test_poses_that_fit_nothing_name_no_cause(seed: int, wrong_poses: Change) -> None:
    plate_cell = cell('plate', seed)
    with refused('misfit', 'contradict'):
        plate_cell.solve(with_poses(plate_cell, wrong_poses))


OTHER_TOOL = se3.perturb(np.eye(4), np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.2]))
BUMPED = se3.perturb(np.eye(4), np.array([0.004, 0.002, 0.0, 0.0, 0.0, 0.01]))

FAR = se3.perturb(np.eye(4), np.array([0.03, 0.02, 0.04, 0.1, 0.05, 0.0]))


def later(samples: tuple[Sample, ...], change: Change) -> list[Sample]:
    """Return samples in the order of time, the poses of the second half changed."""
    ordered = in_order(samples)
    half = len(ordered) // 2
    return ordered[:half] + [replace(s, T_base_flange=change(s.T_base_flange))
                             for s in ordered[half:]]


@pytest.mark.parametrize(('name', 'change', 'words'), [
    *((name, change, words) for name in ('plate', 'sphere') for change, words in (
        (lambda T: T @ OTHER_TOOL, 'the sensor moved in flange by 5'),
        (lambda T: BUMPED @ T, 'the target moved in base, or'))),
    *((name, lambda T: T @ OTHER_TOOL, 'the (sensor|target) moved in ') for name in (
        'plane', 'line')),  # 7 of their 14 samples have few conditions to spare
    ('eye_on_base', lambda T: T @ OTHER_TOOL, 'the target moved in flange, or')])
def test_what_moved_is_named(name: str, change: Change, words: str) -> None:
    simulated_cell = cell(name, 3)
    with pytest.raises(DataError, match=words) as caught:
        simulated_cell.solve(later(simulated_cell.samples, change))
    match = re.search(r'the first (\d+) samples .* the other (\d+),', str(caught.value))
    (first, others), n = map(int, match.groups()), len(simulated_cell.samples)
    assert first + others == n and abs(first - n // 2) <= 2


@pytest.mark.parametrize('name', ['plane', 'sphere'])
def test_parts_with_neither_one_target_nor_one_transform_name_no_move(name: str) -> None:
    # as parts of a few samples with wrong poses fit, by chance
    simulated_cell = cell(name, 3)
    with refused('misfit', 'contradict'):
        simulated_cell.solve(later(simulated_cell.samples, lambda T: FAR @ T @ OTHER_TOOL))


@pytest.mark.thorough
def test_a_target_that_moved_is_no_other_surface() -> None:
    recording = simulate(SCENARIOS['plate'], np.random.default_rng(8))
    config = settings_of(recording.scenario)
    middle = recording.poses[len(recording.poses) // 2].stamp
    poses = [replace(pose, translation=pose.translation + (pose.stamp > middle) * np.array(
        [1.8e-3, 1.44e-3, 1.92e-3])) for pose in recording.poses]
    with pytest.raises(DataError, match='the target seems to have moved in base by about '):
        pipeline.calibrate(recording.profiles, poses, config)


def warnings_or_refusal(samples: list[Sample], config: Config) -> str:
    """Return the warnings of an answer, or the refusal where the evidence is very strong."""
    answer = pipeline.answer_samples(samples, [], config, 'laser')
    return str(answer.refusal or ' '.join(answer.calibration.provenance.get('warnings', ())))


SLIGHT = se3.perturb(np.eye(4), np.array([4e-4, 0.0, 3e-4, 0.0, 0.0, 0.0]))


@pytest.mark.parametrize(('change', 'culprit'), [
    (lambda T: T @ SLIGHT, 'sensor'), (lambda T: SLIGHT @ T, 'target')])
def test_a_small_move_is_reported_with_its_moment(change: Change, culprit: str) -> None:
    plate_cell = cell('plate', 5)
    samples = later(plate_cell.samples, change)
    sentence = warnings_or_refusal(samples, plate_cell.config)
    assert f'the first {len(samples) // 2} ' in sentence and f'the {culprit} ' in sentence
    match = re.search('by about ([0-9.]+) mm', sentence)
    assert match is None or float(match[1]) == pytest.approx(0.5, abs=0.3)


@pytest.mark.parametrize('seed', [1, 4, 114, 118])
def test_a_small_move_is_reported_though_noise_could_explain_it(seed: int) -> None:
    scenario, rng = FAULTS['plane'], np.random.default_rng(seed)
    samples, truth = simulate_samples(scenario, rng)
    X, step = truth.T_flange_sensor, rng.normal(size=3)
    moved = se3.perturb(np.eye(4), np.append(5e-4 * step / np.linalg.norm(step), np.zeros(3)))
    slip = X @ se3.inverse(moved) @ se3.inverse(X)
    sentence = warnings_or_refusal(later(samples, lambda T: T @ slip), settings_of(scenario))
    assert re.search('the first [678] of 14 samples', sentence), sentence


@pytest.mark.parametrize(('name', 'first'), [
    ('sphere', False), *(pytest.param(*values, marks=pytest.mark.thorough) for values in (
        ('sphere', True), ('wedge', False), ('wedge', True)))])
def test_a_move_is_told_while_few_samples_lie_beyond_it(name: str, first: bool) -> None:
    simulated_cell = cell(name, 2)
    rng = np.random.default_rng(1)
    mixed = [replace(simulated_cell.samples[k], stamp=stamp)
             for stamp, k in enumerate(rng.permutation(len(simulated_cell.samples))[:12])]
    bumped = se3.transform(np.eye(3), np.array([0.02, 0.0, 0.0]))
    beyond = mixed[:3] if first else mixed[-3:]
    samples = [replace(s, T_base_flange=bumped @ s.T_base_flange) if s in beyond else s
               for s in mixed]
    words = ('the first 3 of 12 samples contradict the 9 after them' if first else
             'the last 3 of 12 samples contradict the 9 before them')
    assert words in warnings_or_refusal(samples, simulated_cell.config)
    answer = pipeline.answer_samples(samples, [], simulated_cell.config, 'laser')
    advice = advise(samples, simulated_cell.config, answer)
    assert words in advice.why and not advice.enough
    # a single sample may be wrong for another reason, and so may others in any place
    scattered = [replace(s, T_base_flange=bumped @ s.T_base_flange) if k in (1, 5, 9) else s
                 for k, s in enumerate(mixed)]
    assert 'moved' not in warnings_or_refusal(scattered, simulated_cell.config)
    assert 'moved' not in warnings_or_refusal([*mixed[:9], samples[-1]], simulated_cell.config)


def test_outliers_at_one_end_are_told_of_however_many_samples() -> None:
    problem = SimpleNamespace(pose_model=None, poses=range(3000))
    assert outliers_at_one_end(SimpleNamespace(
        problem=problem, full_problem=problem, used=np.arange(2800))).startswith(
        'the last 200 of 3000 samples contradict the 2800 before them')


@pytest.mark.parametrize(('name', 'seed'), [('plate', 2), ('sphere', 1)])
def test_an_answer_that_warns_of_a_move_is_as_uncertain_as_the_move(name: str, seed: int) -> None:
    simulated_cell = cell(name, seed)
    slightly = se3.perturb(np.eye(4), np.array([8e-5, 0.0, 6e-5, 0.0, 0.0, 0.0]))
    answer = pipeline.answer_samples(later(simulated_cell.samples, lambda T: T @ slightly), [],
                                     simulated_cell.config, 'laser')
    calibration = answer.require_calibration()
    assert 'moved' in calibration.provenance['warnings'][0]
    error = se3.difference(calibration.T_flange_sensor, simulated_cell.truth.T_flange_sensor)
    covariance, move = calibration.covariance, answer.solution.added_covariances['possible move']
    assert error @ np.linalg.solve(covariance, error) < chi2_isf(0.05, 6)
    assert error @ np.linalg.solve(covariance - move, error) > chi2_isf(0.05, 6)


@pytest.mark.parametrize('name', ['baseline', 'joints and links 0.1 mm', 'sphere, smooth 0.2 mm'])
def test_a_robot_less_accurate_than_stated_is_no_move(name: str) -> None:
    samples, _ = simulate_samples(FAULTS[name], np.random.default_rng(0))
    config = settings_of(FAULTS[name])
    assert 'warnings' not in pipeline.solve(samples, [], config, 'laser').provenance


def railed(scenario: Scenario) -> tuple[Solid, ...]:
    """Return a plate with a rail 15 mm beside one edge, on a floor."""
    return (*scenes.SCENES['plate'].solids(scenario),
            box((-0.05, -0.055, -0.015), (0.25, -0.015, 0.01)),
            box((-0.3, -0.3, -0.02), (0.5, 0.5, -0.015)))


def barred(scenario: Scenario) -> tuple[Solid, ...]:
    """Return the same with a bar beside a second edge: the gaps look like plates."""
    return *railed(scenario), box((-0.06, -0.05, -0.015), (-0.02, 0.25, -0.005))


@pytest.mark.thorough
def test_ends_of_the_floor_that_scatter_are_no_edges(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the wrong sign the floor between rail and plate is a face, off by centimetres."""
    monkeypatch.setitem(scenes.SCENES, 'railed', replace(scenes.SCENES['plate'], solids=railed))
    scenario = replace(SCENARIOS['plate'], stations=(14, 14), scene='railed')
    recording = simulate(scenario, np.random.default_rng(1))
    config = flipped_range(settings_of(scenario, target__type='plate'))
    with pytest.raises(DataError, match='at several heights .* check profile.range_sign'):
        pipeline.calibrate(recording.profiles, recording.poses, config)


def clamped(scenario: Scenario, height: float, share: float = 1 / 3, lower: float = 1.0
            ) -> tuple[Solid, ...]:
    """
    Return a plate with three clamps on each of two edges, on a share of its length.

    lower: share of the height of those in the middle.
    """
    clamps = []
    for along, length in enumerate(scenario.target.size):
        for middle in (length / 6, length / 2, length * 5 / 6):
            low, high = [-0.01] * 3, [0.015] * 3
            low[along], high[along] = middle - length * share / 6, middle + length * share / 6
            clamps.append(box((*low[:2], 0.0), (
                *high[:2], height * (lower if middle == length / 2 else 1.0))))
    return (*scenes.SCENES['plate'].solids(scenario), *clamps)


@pytest.mark.thorough
@pytest.mark.parametrize(('name', 'seed', 'solids', 'answered'), [
    ('plate', 3, barred, True),  # without the question it would look like the other sign, or
    ('plate', 1, partial(clamped, height=0.003), True),  # like a move
    ('plate', 1, partial(clamped, height=0.015, lower=0.2), True),
    ('plate', 7, barred, True), ('plate', 0, partial(clamped, height=0.015), True),
    ('line', 0, partial(clamped, height=0.015), False)])
def test_the_stops_that_show_another_surface_are_named_and_left_out(
        monkeypatch: pytest.MonkeyPatch, name: str, seed: int,
        solids: Callable[[Scenario], tuple[Solid, ...]], answered: bool) -> None:
    monkeypatch.setitem(scenes.SCENES, 'clamped', replace(
        scenes.SCENES[SCENARIOS[name].scene], solids=solids))
    scenario = replace(SCENARIOS[name], scene='clamped')
    recording = simulate(scenario, np.random.default_rng(seed))
    config = settings_of(scenario, target__type=name)
    session = pipeline.gather(recording.profiles, recording.poses, config)
    T_target_base = se3.inverse(recording.truth.T_base_target)
    elsewhere, heights = [], []
    for stop in (stop for stop in session.stops if stop.sample):
        face = next(f for f in stop.sample.features if isinstance(f, FaceLine))
        T = T_target_base @ stop.sample.T_base_flange @ recording.truth.T_flange_sensor
        height = T[2, [0, 2]] @ face.centre + T[2, 3]
        if abs(height) > 1e-3:
            elsewhere.append(stop)
            heights.append(height)
    answer = pipeline.answer_session(session, config)
    if answered:  # the others are enough
        [sentence] = answer.calibration.provenance['warnings']
        assert {report.stamp for report in answer.calibration.samples
                if not report.used} >= {stop.sample.stamp for stop in elsewhere}
        assert squared_error(answer.calibration, recording.truth) < ONE_IN_100
    else:
        sentence = str(answer.refusal)
        assert answer.refusal.reason == 'surface'
    lowest_highest = re.search(
        r'surface, ([-\d.]+) (?:to ([-\d.]+) )?mm above that of the others', sentence)
    assert [float(height) for height in lowest_highest.groups(default=lowest_highest[1])
            ] == pytest.approx([min(heights) * 1e3, max(heights) * 1e3], abs=0.2), sentence
    match = re.search(r'the stops ([\d, ]+) show', sentence)
    assert [int(number) for number in match[1].split(', ')] == [stop.number for stop in elsewhere]


@pytest.mark.thorough
def test_faces_that_end_where_the_sensor_is_blind_are_named_and_left_out() -> None:
    recording = simulate(SCENARIOS['line'], np.random.default_rng(5))
    blind = np.zeros((len(recording.profiles[0].points), 1), dtype=bool)
    blind[793:844] = True
    profiles = [replace(p, points=np.where(blind, np.nan, p.points)) for p in recording.profiles]
    calibration = pipeline.calibrate(profiles, recording.poses, settings_of(recording.scenario))
    [warning] = calibration.provenance['warnings']
    assert re.fullmatch('the stops [0-9, ]+ show the end of a face where the sensor .*', warning)
    assert squared_error(calibration, recording.truth) < ONE_IN_100


def test_columns_between_plates_in_the_air_are_not_blind() -> None:
    scenario = SCENARIOS['plate_in_air']
    recording = simulate(scenario, np.random.default_rng(101))
    with refused('uncertain'):
        pipeline.calibrate(recording.profiles, recording.poses,
                           settings_of(scenario, limits__translation=5e-5))


@pytest.mark.thorough
def test_heights_of_edges_are_named_if_few_show_a_target(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most stops show a clamp, and one the table: no part of them agrees on one edge."""
    monkeypatch.setitem(scenes.SCENES, 'clamped', replace(
        scenes.SCENES['plate'], solids=partial(clamped, height=0.015, share=0.41)))
    scenario = replace(SCENARIOS['line'], scene='clamped')
    recording = simulate(scenario, np.random.default_rng(2))
    with refused('surface', 'agree on one plane, but not on the edges') as caught:
        pipeline.calibrate(recording.profiles, recording.poses,
                           settings_of(scenario, target__type='line'))
    listed = re.findall(r'(\d+\.\d) mm: stops ([\d, ]+)', str(caught.value))
    heights = [float(height) for height, _ in listed]  # of clamps, target and table
    assert heights == pytest.approx([40.0, 25.0, 0.0], abs=0.2)
    assert [len(numbers.split(', ')) for _, numbers in listed] == [7, 6, 1]
