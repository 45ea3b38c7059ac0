# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""One straight edge: with and without its face, among other edges."""
from __future__ import annotations

from dataclasses import replace
import re

from cells import cell, ONE_IN_1000, recorded, squared_error
from handeye_ros import pipeline
from handeye_ros.config import with_values
from handeye_ros.data import EdgePoint, FaceLine
from handeye_ros.simulate import SCENARIOS
from handeye_ros.simulate.scenario import PlateTarget
import numpy as np
import pytest

LINE = SCENARIOS['line']


def test_points_alone_need_no_face_lines() -> None:
    simulated = cell(LINE, 1)
    bare = [replace(s, features=tuple(f for f in s.features if isinstance(f, EdgePoint)))
            for s in simulated.samples]
    np.testing.assert_allclose(simulated.solve(bare).T_flange_sensor,
                               simulated.solve().T_flange_sensor, atol=1e-9)
    assert any(isinstance(f, FaceLine) for s in simulated.samples for f in s.features)


@pytest.mark.thorough
@pytest.mark.parametrize('width', [0.015, 0.025])
@pytest.mark.parametrize('use_face', [False, True])
def test_a_bar_of_which_both_edges_are_in_sight(width: float, use_face: bool) -> None:
    bar = replace(LINE, target=PlateTarget(size=(0.2, width)))
    recording = recorded(bar, 2, target__use_face=use_face)
    calibration = recording.calibrate()
    assert calibration.quality.samples_used >= 12
    assert recording.error(calibration.T_flange_sensor) < 3e-4


@pytest.mark.thorough
def test_stations_at_another_edge_are_left_out() -> None:
    simulated = cell(replace(LINE, wrong_edges=2), 4)
    calibration = simulated.solve()
    wrong = {s.start for s in simulated.truth.stations if s.label == 'p2'}
    assert {report.stamp for report in calibration.samples if not report.used} == wrong
    assert simulated.error(calibration.T_flange_sensor) < 3e-4


@pytest.mark.thorough
def test_an_edge_between_two_faces_of_which_either_is_taken_with_its_other_end() -> None:
    """Neither all ends nor those of one side lie on one line; the best known ones do."""
    found = 0
    for seed in range(2):
        simulated = cell(LINE, seed)
        samples = []
        for k, sample in enumerate(simulated.samples):
            face, edge = sample.features
            inwards = -edge.direction * ([-1.0, 1.0] if k % 3 else [1.0, 1.0])
            ends = (replace(edge, direction=-inwards, std=4e-6, std_across=4e-6),
                    replace(edge, point=edge.point + 0.03 * inwards, direction=inwards))
            face = replace(face, centre=edge.point + 0.015 * inwards, direction=inwards)
            samples.append(replace(sample, features=(face, *ends)))
        answer = simulated.solve(samples)
        found += simulated.error(answer.T_flange_sensor) < 3e-4
    assert found == 2


@pytest.mark.thorough
@pytest.mark.parametrize('seed', [1, 2])
def test_the_edge_of_a_block_keeps_to_one_face(seed: int) -> None:
    """Of the two faces of the edge now the one, now the other is seen better."""
    simulated = recorded(SCENARIOS['wedge'], seed)
    config = with_values(simulated.config,
                         {'target.type': 'line', 'target.use_face': True}, 'test')
    session = pipeline.gather(simulated.profiles, simulated.poses, config)
    slopes = [f.direction[1] for s in session.samples for f in s.features
              if isinstance(f, FaceLine)]
    assert min(slopes) < 0 < max(slopes)  # both are among them
    answer = pipeline.answer_session(session, config).require_calibration()
    assert answer.quality.samples_used >= 13
    assert squared_error(answer, simulated.truth) < ONE_IN_1000
    points = simulated.calibrate(target__type='line', target__use_face=False)
    assert np.trace(answer.covariance[:3, :3]) < np.trace(points.covariance[:3, :3])


def corner_samples(seed, only_open, count=24):
    """
    Return stations at a corner: its edge on the one side, the reach of the sensor on the other.

    Which face is in sight changes, and so does the side. only_open: stations without the corner.
    """
    rng = np.random.default_rng(seed)
    wide = replace(SCENARIOS['wedge'], sensor=SCENARIOS['sphere'].sensor, stations=(count, 0))
    simulated, samples = cell(wide, seed, target__type='line'), []
    for k, sample in enumerate(simulated.samples):
        a, b = sample.features if rng.random() < 0.5 else sample.features[::-1]
        along = np.linalg.solve(np.column_stack([a.direction, -b.direction]), b.centre - a.centre)
        corner = a.centre + along[0] * a.direction
        out = a.direction * np.sign(along[0])
        std = rng.uniform(5e-6, 65e-6)
        roof = EdgePoint(corner + std * rng.normal() * out, out, std, a.std, 'roof')
        reach = EdgePoint(corner - rng.uniform(0.015, 0.05) * out, -out, 3e-5, a.std, 'open')
        ends = [reach] if k < only_open else [roof, reach]
        samples.append(replace(sample, features=(a, *ends)))
    return replace(simulated, samples=tuple(samples))


@pytest.mark.parametrize('only_open', [1, pytest.param(5, marks=pytest.mark.thorough)])
def test_a_corner_is_not_taken_for_the_reach_of_the_sensor(only_open: int) -> None:
    for seed in range(5):
        simulated = corner_samples(seed, only_open)
        assert simulated.error(simulated.solve().T_flange_sensor) < 5e-4


def test_solved_as_a_plate_it_says_that_no_sample_shows_the_other_edge() -> None:
    simulated = cell(LINE, 0, target__type='plate')
    note = simulated.solve().target['note']
    assert re.match('no sample shows edge [pq] of the target: cross it too', note)


@pytest.mark.parametrize('use_face', [True, False])
def test_an_end_of_the_same_kind_on_the_other_side_of_the_face_is_no_edge(use_face: bool) -> None:
    """The other ends do not lie on one line."""
    simulated = cell(replace(SCENARIOS['line'], stations=(9, 0)), 0, target__use_face=use_face)
    rng, samples = np.random.default_rng(5), []
    for sample in simulated.samples:
        edge = next(f for f in sample.features if isinstance(f, EdgePoint))
        other = replace(edge, direction=-edge.direction,
                        point=edge.point - edge.direction * rng.uniform(0.012, 0.05))
        samples.append(replace(sample, features=(*sample.features, other)))
    calibration = simulated.solve(samples)
    assert simulated.error(calibration.T_flange_sensor) < 1.5e-3
