# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The scales of priors: what the data show of a block, and no more."""
from __future__ import annotations

from handeye_ros.estimation.noise import prior_scales
import numpy as np


def conservative(value: float, std: float) -> float:
    """Return the scale of a single parameter that the data alone put at value +- std."""
    information = 1 / std ** 2
    covariance = np.array([[1 / (1 + information)]])
    _, found = prior_scales(covariance, covariance[0] * value * information,
                            np.array([0]), np.ones(1), np.array([1e8]))
    return float(np.sqrt(found[0]))


def test_what_the_data_hardly_show_is_not_believed_at_several_times_its_prior() -> None:
    assert conservative(9.0, 6.0) < 2.0, 'of 1.5 sigma'
    assert conservative(0.0, 2.0) > 0.7, 'it may be there as configured'


def test_what_the_data_show_is_believed_however_large() -> None:
    assert conservative(50.0, 0.5) > 20.0
    assert conservative(0.0, 0.01) < 0.3
