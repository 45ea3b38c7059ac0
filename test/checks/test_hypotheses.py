# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What counts as explaining the same stops better."""
from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
import math

from cells import Cell, cell
from handeye_ros import se3
from handeye_ros.checks.hypotheses import (
    DECISIVE_EVIDENCE,
    explain_samples,
    Explanation,
    Hypothesis,
    MIN_REDUNDANCY,
    refuse_by_best,
    stops_deviance,
)
from handeye_ros.data import Array, EdgePoint
from handeye_ros.errors import DataError
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest


# from 0.8: without a stop that is far worse than all others, the rest may be explained better
@given(arrays(float, 12, elements=st.floats(0.8, 4.0)), st.floats(1.05, 4.0), st.integers(0, 11))
def test_a_worse_fit_of_the_same_stops_explains_less(q: Array, worse: float, lost: int) -> None:
    """With more conditions a stop, a sign of 0.104 mm once explained better than one of 0.056."""
    assert stops_deviance(worse * q, 3) > stops_deviance(q, 3)
    assert stops_deviance(np.where(np.arange(12) == lost, np.inf, q), 3) > stops_deviance(q, 3)


def test_edges_that_are_less_certain_do_not_explain_more() -> None:
    """Waves of a face end it by chance with the wrong sign, at points of which little is known."""
    plate_cell, rng = cell('plate'), np.random.default_rng(0)

    def fit_of(error: float, stated: float) -> Explanation:
        samples = [replace(s, features=tuple(
            replace(f, point=f.point + rng.normal(0, error) * f.direction, std=stated)
            if isinstance(f, EdgePoint) else f for f in s.features)) for s in plate_cell.samples]
        return explain_samples(samples, plate_cell.config, [s.stamp for s in samples])

    waved, stray = fit_of(6e-5, 2e-5), fit_of(2e-4, 3e-4)
    assert stray.reduced_chi_squared < waved.reduced_chi_squared
    assert stray.evidence_over(waved) < 0


OTHER = DataError('another assumption')


def test_two_changes_need_twice_the_evidence() -> None:
    plate_cell = cell('plate')
    changed, as_set = explain_samples(plate_cell.samples, plate_cell.config), shaken(plate_cell)
    evidence = changed.evidence_over(as_set)
    # as many tried that each change needs two thirds of this evidence
    tried = round(math.exp((evidence / 1.5 - DECISIVE_EVIDENCE) / 2))
    refuse_by_best(as_set, [Hypothesis(changed, OTHER, changes=2)], tried)
    with pytest.raises(DataError, match='another assumption'):
        refuse_by_best(as_set, [Hypothesis(changed, OTHER)], tried)


def test_a_fit_with_few_redundant_conditions_is_not_believed() -> None:
    line_cell = cell('line')
    for count, redundancy in ((7, 4), (8, 6)):
        fit = explain_samples(line_cell.samples[:count], line_cell.config)
        assert fit.agrees and fit.redundancy == redundancy
        with nullcontext() if redundancy < MIN_REDUNDANCY else pytest.raises(DataError):
            refuse_by_best(Explanation(fit.stamps), [Hypothesis(fit, OTHER)])


def test_a_fit_of_too_few_of_the_stops_explains_nothing() -> None:
    plate_cell = cell('plate')
    as_set, stamps = shaken(plate_cell), [sample.stamp for sample in plate_cell.samples]
    assert len(as_set.left_out_squares) == len(stamps) == 18
    for count, is_named in ((16, False), (17, True)):  # of 18 at least 0.9
        fit = explain_samples(plate_cell.samples[:count], plate_cell.config, stamps)
        assert fit.believable
        with pytest.raises(DataError) if is_named else nullcontext():
            refuse_by_best(as_set, [Hypothesis(fit, OTHER)])


def shaken(simulated_cell: Cell) -> Explanation:
    """Return the explanation of samples whose poses are off by more than the noise allows."""
    rng = np.random.default_rng(0)
    return explain_samples([
        replace(s, T_base_flange=se3.perturb(s.T_base_flange, rng.normal(0, 1e-4, 6)))
        for s in simulated_cell.samples], simulated_cell.config)
