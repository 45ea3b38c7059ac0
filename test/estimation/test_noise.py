# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The scales of priors: what the data show of a block, and no more."""
from __future__ import annotations

from handeye_ros.estimation.noise import prior_scales
import numpy as np
import pytest


def conservative(value: float, std: float) -> float:
    """Return the scale of a single parameter that the data alone put at value +- std."""
    information = 1 / std ** 2
    covariance = np.array([[1 / (1 + information)]])
    _, found = prior_scales(covariance, covariance[0] * value * information,
                            np.array([0]), np.ones(1), np.array([1e8]))
    return float(np.sqrt(found[0]))


@pytest.mark.parametrize(('value', 'std', 'least', 'most'), [
    (9.0, 6.0, 0.0, 2.0),  # of 1.5 sigma: not believed at several times its prior
    (0.0, 2.0, 0.7, 2.0),  # it may be there as configured
    (50.0, 0.5, 20.0, 100.0), (0.0, 0.01, 0.0, 0.3)])  # what the data show is believed
def test_a_scale_is_what_the_data_show_and_no_more(value: float, std: float, least: float,
                                                   most: float) -> None:
    assert least < conservative(value, std) < most
