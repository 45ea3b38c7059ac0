# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Prior widths of blocks, (6), and variance factors, (7)."""
from __future__ import annotations

from dataclasses import replace

from cells import cell, solved
from handeye_ros.data import Array
from handeye_ros.estimation.noise import (
    covariance_parts,
    FACE_INDEX,
    FACTOR_FREEDOM,
    NoiseModel,
    POSE_INDEX,
    tau_squares_of_block,
)
from handeye_ros.estimation.posterior import Posterior, posterior_at
from handeye_ros.simulate import SCENARIOS
import numpy as np
import pytest


@pytest.mark.parametrize(('count', 'scale'), [(2, 1.3), (10, 1.3), (1, 1.7)])
def test_without_evidence_a_scale_is_for_the_report_as_documented(count: int, scale: float
                                                                  ) -> None:
    _, for_report = tau_squares_of_block(np.eye(count), np.zeros(count), 1.0, 400.0)
    assert np.sqrt(for_report) == pytest.approx(scale, abs=0.05)


@pytest.mark.parametrize(('value', 'std', 'least', 'most'), [
    (9.0, 6.0, 0.0, 2.0),  # of 1.5 sigma: not believed at several times its prior
    (0.0, 2.0, 0.7, 2.0),  # it may be there as configured
    (50.0, 0.5, 20.0, 100.0), (0.0, 0.01, 0.0, 0.3)])  # what the data show is believed
def test_a_scale_is_what_data_show(value: float, std: float, least: float, most: float) -> None:
    """Of a single parameter that the data alone put at value +- std."""
    information = 1 / std ** 2
    covariance = np.array([[1 / (1 + information)]])
    _, for_report = tau_squares_of_block(covariance, covariance[0] * value * information, 1.0, 1e8)
    assert least < np.sqrt(for_report) < most


def dense_sums(posterior: Posterior) -> Array:
    """Return phi e' V~ e and phi tr(V~ (I - A C A')) of (7) for each factor, (2, p)."""
    groups = posterior.problem.observations.station_groups
    factors = posterior.noise.variance_factors[:len(covariance_parts(posterior.linear, groups[0]))]
    parts = np.zeros((len(factors), *[len(posterior.prefit_residuals)] * 2))
    for group in groups:
        for number, rows in enumerate(group.rows):
            parts[:, rows[:, None], rows] = covariance_parts(posterior.linear, group)[:, number]
    W = np.linalg.inv(np.linalg.cholesky(np.tensordot(factors, parts, 1)))
    A = W @ posterior.linear.jacobian[:, posterior.problem.free_columns]
    C = np.linalg.inv(A.T @ A)
    r = W @ posterior.linear.residuals
    e = r - A @ C @ A.T @ r
    return np.array([[phi * e @ W @ part @ W.T @ e,
                      phi * np.trace(W @ part @ W.T @ (np.eye(len(r)) - A @ C @ A.T))]
                     for phi, part in zip(factors, parts, strict=True)]).T


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('name', ['plate', 'sphere'])
def test_the_variance_factors_are_those_of_the_noise(name: str, seed: int) -> None:
    """Of poses whose errors have four times the configured variance."""
    scenario = SCENARIOS[name]
    shift, turn = scenario.robot.repeatability
    noisier = replace(scenario, stops=(24, 24),
                      robot=replace(scenario.robot, repeatability=(2 * shift, 2 * turn)))
    solution = solved(cell(noisier, seed, noise__robot_translation=shift,
                           noise__robot_rotation=turn).problem)
    posterior = posterior_at(solution.problem, solution.estimate, NoiseModel())
    for _ in range(60):
        posterior = posterior.with_estimated_factors()
    squares, freedom = dense_sums(posterior)
    phi = posterior.noise.variance_factors[:len(squares)]
    assert squares + FACTOR_FREEDOM / phi == pytest.approx(freedom + FACTOR_FREEDOM, rel=1e-3)
    for index, true in ((FACE_INDEX, 1.0), (POSE_INDEX, 4.0)):
        assert abs(np.log(phi[index] / true)) < 3 * (2 / freedom[index]) ** 0.5
