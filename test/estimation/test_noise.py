# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Prior widths of blocks, (6)."""
from __future__ import annotations

from handeye_ros.estimation.noise import prior_variances
import numpy as np
import pytest


@pytest.mark.parametrize(('count', 'scale'), [(2, 1.3), (10, 1.3), (1, 1.7)])
def test_without_evidence_a_scale_is_for_the_report_as_documented(count: int, scale: float
                                                                  ) -> None:
    _, for_report = prior_variances(np.eye(count), np.zeros(count), 1.0, 400.0)
    assert np.sqrt(for_report) == pytest.approx(scale, abs=0.05)


@pytest.mark.parametrize(('value', 'std', 'least', 'most'), [
    (9.0, 6.0, 0.0, 2.0),  # of 1.5 sigma: not believed at several times its prior
    (0.0, 2.0, 0.7, 2.0),  # it may be there as configured
    (50.0, 0.5, 20.0, 100.0), (0.0, 0.01, 0.0, 0.3)])  # what the data show is believed
def test_a_scale_is_what_data_show(value: float, std: float, least: float, most: float) -> None:
    """Of a single parameter that the data alone put at value +- std."""
    information = 1 / std ** 2
    covariance = np.array([[1 / (1 + information)]])
    _, for_report = prior_variances(covariance, covariance[0] * value * information, 1.0, 1e8)
    assert least < np.sqrt(for_report) < most
