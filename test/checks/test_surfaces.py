# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Stops that show another surface are named and not used."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
import re

from cells import ONE_IN_100, refused, simulated, squared_error
from handeye_ros import pipeline, se3
from handeye_ros.config import with_flipped_range
from handeye_ros.data import FaceLine
from handeye_ros.errors import DataError
from handeye_ros.simulate import Scenario, SCENARIOS, scenes
from handeye_ros.simulate.solids import box, Solid
import pytest


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
    scenario = replace(SCENARIOS['plate'], stops=(14, 14), scene='railed')
    recording = simulated(scenario, 1, target__type='plate')
    config = with_flipped_range(recording.config)
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
def test_the_stops_that_show_another_surface_are_named_and_not_used(
        monkeypatch: pytest.MonkeyPatch, name: str, seed: int,
        solids: Callable[[Scenario], tuple[Solid, ...]], answered: bool) -> None:
    monkeypatch.setitem(scenes.SCENES, 'clamped', replace(
        scenes.SCENES[SCENARIOS[name].scene], solids=solids))
    scenario = replace(SCENARIOS[name], scene='clamped')
    recording = simulated(scenario, seed, target__type=name)
    session = pipeline.gather(recording.profiles, recording.poses, recording.config)
    T_target_base = se3.inverse(recording.truth.T_base_target)
    elsewhere, heights = [], []
    for stop in (stop for stop in session.stops if stop.sample):
        face = next(f for f in stop.sample.features if isinstance(f, FaceLine))
        T = T_target_base @ stop.sample.T_base_flange @ recording.truth.T_flange_sensor
        height = T[2, [0, 2]] @ face.centre + T[2, 3]
        if abs(height) > 1e-3:
            elsewhere.append(stop)
            heights.append(height)
    answer = pipeline.answer_session(session, recording.config)
    if answered:  # the others are enough
        [sentence] = answer.calibration.provenance['warnings']
        assert {report.stamp for report in answer.calibration.samples
                if not report.used} >= {stop.sample.stamp for stop in elsewhere}
        assert squared_error(answer.calibration, recording.truth) < ONE_IN_100
    else:
        sentence = str(answer.refusal)
        assert answer.refusal.code == 'surface'
    lowest_highest = re.search(
        r'surface, ([-\d.]+) (?:to ([-\d.]+) )?mm above that of the others', sentence)
    assert [float(height) for height in lowest_highest.groups(default=lowest_highest[1])
            ] == pytest.approx([min(heights) * 1e3, max(heights) * 1e3], abs=0.2), sentence
    match = re.search(r'the stops ([\d, ]+) show', sentence)
    assert [int(number) for number in match[1].split(', ')] == [stop.number for stop in elsewhere]


@pytest.mark.thorough
def test_heights_of_edges_are_named_if_few_show_a_target(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most stops show a clamp, and one the table: no part of them agrees on one edge."""
    monkeypatch.setitem(scenes.SCENES, 'clamped', replace(
        scenes.SCENES['plate'], solids=partial(clamped, height=0.015, share=0.41)))
    scenario = replace(SCENARIOS['line'], scene='clamped')
    with refused('surface', 'agree on one plane, but not on the edges') as caught:
        simulated(scenario, 2, target__type='line').calibrate()
    listed = re.findall(r'(\d+\.\d) mm: stops ([\d, ]+)', str(caught.value))
    heights = [float(height) for height, _ in listed]  # of clamps, target and table
    assert heights == pytest.approx([40.0, 25.0, 0.0], abs=0.2)
    assert [len(numbers.split(', ')) for _, numbers in listed] == [7, 6, 1]
