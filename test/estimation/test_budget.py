# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What each cause contributes to the reported covariance."""
from __future__ import annotations

from cells import cell
from handeye_ros import pipeline
from handeye_ros.config import Config, with_values
from handeye_ros.estimation.covariance import budget
from handeye_ros.simulate import settings
import numpy as np
import pytest


@pytest.mark.parametrize('target', ['plate', 'sphere'])
def test_the_parts_add_up_to_what_is_reported(target: str) -> None:
    made = cell(target, 0)
    config = with_values(Config(), settings(made.scenario), target)
    solution = pipeline.answer(made.samples, (), config).consensus()
    found = budget(solution)
    assert found.samples == len(made.samples)
    assert {'sensor, white', 'poses, white', 'robot_smooth', 'best fit'} <= {
        term.name for term in found.terms}
    for size in ('translation', 'rotation', 'mapped'):
        squares = sum(getattr(term, size) ** 2 for term in found.terms)
        assert squares == pytest.approx(getattr(found.total, size) ** 2, rel=1e-6)
    std = np.sqrt(np.diag(solution.reported)[:3])
    assert found.total.translation == pytest.approx(np.sqrt((std ** 2).mean()))
