# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A range counted the wrong way is named where the fit shows it, and only there."""
from __future__ import annotations

from dataclasses import replace

from cells import cell
from handeye_ros import pipeline
from handeye_ros.checks.hypotheses import deviance, Explanation, refitted
from handeye_ros.config import Config, flipped_range, with_values
from handeye_ros.data import Array, EdgePoint
from handeye_ros.errors import DataError
from handeye_ros.sampling.sweep import problem_at_poses
from handeye_ros.simulate import SCENARIOS, settings, simulate
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest


@pytest.mark.parametrize('name, seed', [('plate', 0), ('plate_z_up', 1)])
def test_a_range_counted_the_wrong_way_is_named(name: str, seed: int) -> None:
    scenario = replace(SCENARIOS[name], sensor=replace(SCENARIOS[name].sensor, rate=10.0))
    made = simulate(scenario, np.random.default_rng(seed))
    right = with_values(Config(), settings(scenario), 'the test')
    with pytest.raises(DataError, match=f'range_sign {right.profile.range_sign}, '):
        pipeline.calibrate(made.profiles, made.poses, flipped_range(right))


@given(arrays(float, 12, elements=st.floats(0.1, 4.0)), st.floats(1.05, 4.0), st.integers(0, 11))
def test_what_fits_the_same_stops_worse_is_no_better_explanation(
        q: Array, worse: float, lost: int) -> None:
    """With more conditions a stop, a sign of 0.104 mm once explained better than one of 0.056."""
    assert deviance(worse * q, 3) > deviance(q, 3)
    assert deviance(np.where(np.arange(12) == lost, np.inf, q), 3) > deviance(q, 3)


def test_edges_that_are_less_certain_do_not_explain_more() -> None:
    """Waves of a face end it by chance with the wrong sign, at points of which little is known."""
    made, rng = cell('plate'), np.random.default_rng(0)

    def read(error: float, stated: float) -> Explanation:
        samples = [replace(s, features=tuple(
            replace(f, point=f.point + rng.normal(0, error) * f.direction, std=stated)
            if isinstance(f, EdgePoint) else f for f in s.features)) for s in made.samples]
        return refitted(problem_at_poses(samples, made.config))

    waved, stray = read(6e-5, 2e-5), read(2e-4, 3e-4)
    assert stray.variance_factor < waved.variance_factor
    assert stray.evidence_against(waved) < 0
