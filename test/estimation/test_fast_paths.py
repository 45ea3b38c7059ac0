# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What is done quickly in estimating gives what the plain way of the same gives."""
from __future__ import annotations

from dataclasses import replace

from cells import cell, solved
from handeye_ros import se3
from handeye_ros.estimation import solve
from handeye_ros.estimation.solve import map_solution
from handeye_ros.outcome import Measured
from handeye_ros.simulate import SCENARIOS
from handeye_ros.targets import sphere
import numpy as np
import pytest


@pytest.mark.parametrize('seed', range(3))
def test_rotations_that_are_not_tried_on_both_sides_fit_worse(
        seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    made = cell('sphere', seed)
    quick = sphere._candidates(made.problem, made.config.target.radius)
    monkeypatch.setattr(sphere, 'AT_ONCE', sphere.ROTATIONS)
    for some, all_tried in zip(quick, sphere._candidates(
            made.problem, made.config.target.radius), strict=True):
        np.testing.assert_array_equal(some.X, all_tried.X)


def test_measured_points_are_mapped_as_observed_ones_are() -> None:
    problem, X = cell('plate').problem, np.linalg.inv(cell('sphere').truth.T_flange_sensor)
    obs = problem.observations
    measured = Measured(obs.points, obs.kind, obs.station)
    np.testing.assert_allclose(measured.mapped(problem.poses @ X), problem.points_in_base(X),
                               atol=1e-12)


def test_some_of_many_stations_lead_to_the_answer_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    made = cell(replace(SCENARIOS['plate'], stations=(30, 30)), noise__robot_smooth=1e-4)
    start = solved(made.problem).estimate
    plain = map_solution(made.problem, start)
    monkeypatch.setattr(solve, 'MANY', 20)
    quick = map_solution(made.problem, start)
    off = se3.difference(quick.estimate.X, plain.estimate.X)
    std = np.sqrt(np.diag(plain.reported)[:6])
    assert 0 < np.abs(off / std).max() < 0.2
    np.testing.assert_allclose(np.sqrt(np.diag(quick.reported)[:6]), std, rtol=0.2)
