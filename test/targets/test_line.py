# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""One straight edge: with and without its face, among other edges."""
from __future__ import annotations

from dataclasses import replace
import re

from cells import cell, ONE_IN_1000, recorded, set_to, squared_error
from handeye_ros import pipeline
from handeye_ros.data import EdgePoint, FaceLine
from handeye_ros.simulate import SCENARIOS
from handeye_ros.simulate.scenario import PlateTarget
import numpy as np
import pytest
from quick import long_run

LINE = SCENARIOS['line']


def test_points_alone_need_no_face_lines() -> None:
    line_cell = cell(LINE, 1)
    bare = [replace(s, features=tuple(f for f in s.features if isinstance(f, EdgePoint)))
            for s in line_cell.samples]
    T, T_bare = (line_cell.solve(s).T_flange_sensor for s in (line_cell.samples, bare))
    np.testing.assert_allclose(T_bare, T, atol=1e-9)
    assert any(isinstance(f, FaceLine) for s in line_cell.samples for f in s.features)


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
    line_cell = cell(replace(LINE, wrong_edges=2), 4)
    calibration = line_cell.solve()
    wrong_stamps = {s.start for s in line_cell.truth.stops if s.label == 'p_far'}
    assert {report.stamp for report in calibration.samples if not report.used} == wrong_stamps
    assert line_cell.error(calibration.T_flange_sensor) < 3e-4


@pytest.mark.thorough
def test_an_edge_is_found_whichever_of_its_two_faces_is_taken() -> None:
    """Neither all ends nor those of one side lie on one line; the best known ones do."""
    for seed in range(2):
        line_cell = cell(LINE, seed)
        samples = []
        for k, sample in enumerate(line_cell.samples):
            face, edge = sample.features
            inwards = -edge.direction * ([-1.0, 1.0] if k % 3 else [1.0, 1.0])
            ends = (replace(edge, direction=-inwards, std=4e-6, std_across=4e-6),
                    replace(edge, point=edge.point + 0.03 * inwards, direction=inwards))
            face = replace(face, centre=edge.point + 0.015 * inwards, direction=inwards)
            samples.append(replace(sample, features=(face, *ends)))
        calibration = line_cell.solve(samples)
        assert line_cell.error(calibration.T_flange_sensor) < 3e-4


@pytest.mark.thorough
@pytest.mark.parametrize('seed', [1, 2])
def test_the_edge_of_a_block_keeps_to_one_face(seed: int) -> None:
    """Of the two faces of the edge now the one, now the other is seen better."""
    recording = recorded(SCENARIOS['wedge'], seed)
    config = set_to(recording.config, target__type='line', target__use_face=True)
    session = pipeline.gather(recording.profiles, recording.poses, config)
    slopes = [f.direction[1] for s in session.samples for f in s.features
              if isinstance(f, FaceLine)]
    assert min(slopes) < 0 < max(slopes)  # both are among them
    with_face = pipeline.answer_session(session, config).require_calibration()
    assert with_face.quality.samples_used >= 13
    assert squared_error(with_face, recording.truth) < ONE_IN_1000
    without_face = recording.calibrate(target__type='line', target__use_face=False)
    assert np.trace(with_face.covariance[:3, :3]) < np.trace(without_face.covariance[:3, :3])


def corner_samples(seed, only_open, count=24):
    """
    Return stations at a corner: its edge on the one side, the reach of the sensor on the other.

    Which face is in sight changes, and so does the side. only_open: stations without the corner.
    """
    rng = np.random.default_rng(seed)
    wide = replace(SCENARIOS['wedge'], sensor=SCENARIOS['sphere'].sensor, stops=(count, 0))
    line_cell, samples = cell(wide, seed, target__type='line'), []
    for k, sample in enumerate(line_cell.samples):
        a, b = sample.features if rng.random() < 0.5 else sample.features[::-1]
        along = np.linalg.solve(np.column_stack([a.direction, -b.direction]), b.centre - a.centre)
        corner = a.centre + along[0] * a.direction
        out = a.direction * np.sign(along[0])
        std = rng.uniform(5e-6, 65e-6)
        roof = EdgePoint(corner + std * rng.normal() * out, out, std, a.std, 'roof')
        reach = EdgePoint(corner - rng.uniform(0.015, 0.05) * out, -out, 3e-5, a.std, 'open')
        ends = [reach] if k < only_open else [roof, reach]
        samples.append(replace(sample, features=(a, *ends)))
    return replace(line_cell, samples=tuple(samples))


@pytest.mark.parametrize('only_open', [1, *long_run(5)])
def test_a_corner_is_not_taken_for_the_reach_of_the_sensor(only_open: int) -> None:
    for seed in range(5):
        corner_cell = corner_samples(seed, only_open)
        assert corner_cell.error(corner_cell.solve().T_flange_sensor) < 5e-4


def test_solved_as_a_plate_it_says_that_no_sample_shows_the_other_edge() -> None:
    line_cell = cell(LINE, 0, target__type='plate')
    note = line_cell.solve().target['note']
    assert re.match('no sample shows edge [pq] of the target: cross it too', note)


@pytest.mark.parametrize('use_face', [True, False])
def test_an_end_on_the_other_side_of_the_face_is_no_edge(use_face: bool) -> None:
    """The other ends do not lie on one line."""
    line_cell = cell(replace(SCENARIOS['line'], stops=(9, 0)), 0, target__use_face=use_face)
    rng, samples = np.random.default_rng(5), []
    for sample in line_cell.samples:
        edge = next(f for f in sample.features if isinstance(f, EdgePoint))
        other_edge = replace(edge, direction=-edge.direction,
                             point=edge.point - edge.direction * rng.uniform(0.012, 0.05))
        samples.append(replace(sample, features=(*sample.features, other_edge)))
    calibration = line_cell.solve(samples)
    assert line_cell.error(calibration.T_flange_sensor) < 1.5e-3
