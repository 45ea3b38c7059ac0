# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Without noise every target gives the truth; what each motion lets it know is what ranks say."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
import re

from cells import Cell, cell, exact_cell, solution_of
from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import DataError
from handeye_ros.estimation.problem import Estimate, linearise, UNUSED
from handeye_ros.simulate import SCENARIOS
from handeye_ros.targets import TARGETS
import numpy as np
import pytest


def vector(point: dict[str, float]) -> Array:
    return np.array([point[axis] for axis in 'xyz'])


@pytest.mark.parametrize(('scene', 'values'), [
    ('plate', {}), ('line', {}), ('line', {'target__use_face': True}), ('plane', {}),
    ('wedge', {}), ('groove', {}), ('sphere', {}), ('sphere', {'target__radius': 0.0})])
@pytest.mark.parametrize('where', ['eye_in_hand', 'eye_on_base'])
@pytest.mark.parametrize('seed', range(2))
def test_the_truth_is_found(scene: str, values: dict[str, object], where: str, seed: int) -> None:
    simulated_cell = exact_cell(replace(SCENARIOS[scene], calibration_type=where), seed, **values)
    calibration = simulated_cell.solve()
    error = se3.difference(calibration.T_flange_sensor, simulated_cell.truth.T_flange_sensor)
    assert np.abs(error).max() < 1e-6
    target, T = calibration.target, simulated_cell.truth.T_base_target
    for axis, key in ((0, 'direction'), (2, 'normal')):
        if key in target:
            assert abs(np.array(target[key]) @ T[:3, axis]) == pytest.approx(1.0)
    if 'point' in target:
        distance = np.cross(vector(target['point']) - T[:3, 3], T[:3, 0])
        assert np.linalg.norm(distance) < 1e-6
    if 'distance' in target:
        assert target['distance'] == pytest.approx(np.array(target['normal']) @ T[:3, 3], abs=1e-6)
    if 'face_angle' in target:
        assert target['face_angle'] == pytest.approx(np.pi / 2, abs=1e-6)
    if 'centre' in target:
        assert np.linalg.norm(vector(target['centre']) - T[:3, 3]) < 1e-6


@pytest.mark.parametrize('name', TARGETS)
def test_a_measure_changes_as_the_parameter_of_its_name(name: str) -> None:
    target, state = TARGETS[name], solution_of(name).estimate.state
    for k, parameter in enumerate(target.parameter_names):
        step = 1e-3 * np.eye(len(target.parameter_names))[k]
        before, after = map(target.measures, (state, target.retract(state, step)))
        assert after == pytest.approx(before | ({parameter: before[parameter] + 1e-3}
                                                if parameter in before else {}))


def test_a_plane_of_which_yaw_leaves_the_position_open_is_refused() -> None:
    plane_cell = cell(replace(SCENARIOS['plane'], motion='yaw_only'))
    with pytest.raises(DataError, match=r'if it is the normal of the plane \(yaw only\) all of '
                       'the position.*tilt the tool by 15 degrees or more about flange'):
        plane_cell.solve()


DOCUMENT = Path(__file__).parents[2] / 'docs' / 'estimator.md'
ROWS = {'general': 'general', 'one orientation': 'one_orientation',
        'one orientation per edge': 'one_orientation_per_edge',
        'tilts about the laser line only': 'tilt_only',
        'yaw about the face normal only': 'yaw_only'}
ZERO = 1e-8
WEDGE_TURNS = [np.pi / 2, 0.0]  # of a block's faces, z = 0 and y = 0, about its edge


def table() -> Iterator[tuple[str, str, int, int]]:
    """Yield motion, method, rank and number of unknowns of every cell of the table."""
    lines = DOCUMENT.read_text(encoding='utf-8').splitlines()
    start = next(i for i, text in enumerate(lines) if text.startswith('| motion | line'))
    header = re.findall(r'([a-z ]+?) /(\d+)', lines[start])
    for text in lines[start + 2:start + 2 + len(ROWS)]:
        motion, *ranks = [cell.strip() for cell in text.strip('|').split('|')]
        for (name, unknowns), rank in zip(header, ranks, strict=True):
            yield motion, name.strip(), int(rank), int(unknowns)


def at_truth(cell: Cell) -> Estimate:
    T = cell.truth.T_base_target
    radius = getattr(cell.scenario.target, 'radius', 0.0)
    targets = {'plate': np.append(T.ravel(), [0.0, 0.0, np.pi / 2]),
               'line': T.ravel(), 'plane': T.ravel(),
               'sphere': np.append(T.ravel(), radius),
               'wedge': np.append(T.ravel(), WEDGE_TURNS)}
    return Estimate(cell.truth.T_flange_sensor, targets[cell.problem.target.name])


def test_the_table_of_the_document_has_every_motion_and_target() -> None:
    cells = list(table())
    assert {motion for motion, *_ in cells} == set(ROWS)
    assert {name.split()[0] for _, name, *_ in cells} == set(TARGETS)


@pytest.mark.parametrize(('motion', 'name', 'rank', 'unknowns'), list(table()))
def test_a_motion_shows_what_is_stated(motion: str, name: str, rank: int, unknowns: int) -> None:
    """By the derivatives by all unknowns, each column scaled to length 1."""
    target = name.split()[0]
    stops = (20, 20) if target == 'plate' else (40, 0)
    scenario = replace(SCENARIOS[target], motion=ROWS[motion], stops=stops)
    simulated_cell = exact_cell(scenario, target__use_face=name == 'line with its face')
    problem, estimate = simulated_cell.problem, at_truth(simulated_cell)
    p = problem.points_in_base(estimate.X)
    observations = problem.target.reassign(problem.observations, p, estimate.state, problem.config)
    used = observations.select(observations.kind != UNUSED)
    problem = replace(problem, observations=used)
    linear = linearise(problem, estimate)
    assert np.abs(linear.residuals).max() < 1e-9
    J = linear.jacobian[:, problem.free_columns]
    values = np.linalg.svd(J / np.maximum(np.linalg.norm(J, axis=0), 1e-12), compute_uv=False)
    assert len(values) == unknowns
    assert int((values > ZERO).sum()) == rank
