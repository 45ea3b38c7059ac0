# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A plate: which of its edges samples use."""
from __future__ import annotations

from dataclasses import replace

from cells import cell
from handeye_ros.simulate import SCENARIOS
import numpy as np
import pytest


@pytest.mark.thorough
def test_all_four_edges_are_used_when_the_size_is_known() -> None:
    with_size = cell('wrong_edges', 1, target__size=[0.2, 0.15])
    without_size = cell('wrong_edges', 1)
    calibration = with_size.solve()
    stops = with_size.truth.stops
    labels = {s.stamp: t.label for s, t in zip(with_size.samples, stops, strict=True)}
    used = {(labels[r.stamp], r.edge) for r in calibration.samples}
    assert all(edge for _, edge in used) and len(used) == len(set(labels.values()))
    # the noise is estimated in both
    assert np.trace(calibration.covariance) < np.trace(without_size.solve().covariance) * 1.05


def test_edges_that_are_none_of_the_plate_are_reported() -> None:
    plate_cell = cell(replace(SCENARIOS['plate'], wrong_edges=4))
    calibration = plate_cell.solve()
    assert 'the edges of 4 of the 18 samples' in calibration.target['note']
    assert plate_cell.error(calibration.T_flange_sensor) < 9e-5
