# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The part of the reported covariance for a station that may be wrong, (10).

With few stations, a wrong one may not show in the residuals. The hypotheses that one station has a
small pose error and that all are right are compared by their odds (Box and Tiao 1968, Biometrika
55:119). Noise and blocks stay as configured: if they could grow with the misfit, a wrong station
would be hidden.
"""
from __future__ import annotations

from dataclasses import replace

from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import chi2_sf
from handeye_ros.estimation.noise import NoiseModel
from handeye_ros.estimation.posterior import Posterior, posterior_at
from handeye_ros.estimation.solution import Solution
import numpy as np

POSE_ERROR = np.repeat([1e-3, 3e-3], 3)  # 1 sigma of a wrong station's pose error (m, rad)
ONE_WRONG = 'one station wrong'  # its part in a budget
PRIOR_ODDS_WRONG = 0.05  # of one station being wrong against all being right
SURE_ODDS = 100.0  # posterior odds of one station being wrong, above which it is dropped
MIN_P = 0.2  # p-value of the other squares; below it more than one is wrong


def with_possibly_wrong_station(solution: Solution) -> Solution:
    """
    Return a solution with its contamination, (10), and the station that is almost surely wrong.

    Between problem.enough_stations stations and twice as many the probabilities fade to 0.
    Stations dropped as wrong make another wrong one likelier.
    """
    problem = solution.problem
    n, dropped = len(solution.used_stations), len(solution.dropped_squares)
    faded = min(1.0, 2 - n / problem.enough_stations)
    configured = posterior_at(problem, solution.estimate, NoiseModel())
    explained, log_likelihood_ratio, added = _each_station_wrong(configured)
    # posterior probability that each is the only wrong one, against that none is (odds 1); all
    # odds are divided by the largest, as their exponentials may be no numbers
    log_odds = log_likelihood_ratio + np.log(PRIOR_ODDS_WRONG + dropped / (n + dropped))
    largest = max(0.0, float(log_odds.max()))
    odds = np.exp(log_odds - largest)
    probability = faded * odds / (np.exp(-largest) + odds.sum())
    # the likeliest is surely wrong if the others fit without it
    worst = int(np.argmax(probability))
    freedom = max(configured.degrees_of_freedom - len(POSE_ERROR), 1)
    p_of_others = chi2_sf(max(configured.sum_of_squares - explained[worst], 0.0), freedom)
    sure = probability[worst] > SURE_ODDS * (1 - probability[worst]) and p_of_others > MIN_P
    return replace(solution, added_covariances={ONE_WRONG: np.tensordot(probability, added, 1)},
                   probability_wrong=float(probability.sum()),
                   surely_wrong_indices=(worst,) if sure else ())


def _each_station_wrong(configured: Posterior) -> tuple[Array, Array, Array]:
    """
    Return what a wrong pose would mean, for each station.

    (n,) by how much the sum of squares falls if that station's pose is wrong; (n,) the log of the
    likelihood ratio of this against all being right; (n, 6, 6) the mean square of the change of
    the transform, Sigma_i + h_i h_i' in (10).

    With r the whitened residuals of the fit to all, those of a fit with one wrong pose are
    r + A x + K e: e is the error of the pose, of unit covariance a priori, and x the change of the
    fit (with the covariance C). For a given e, x = -G e with G = C A'K. Without x, e has the
    information M = 1 + K'K - K'A G and the estimate e = -M^-1 K'r. So the squares fall by
    r'K M^-1 K'r, the log ratio is half of (this less log det M), h = -G e and
    Sigma_i = G M^-1 G'.
    """
    n, C = len(configured.problem.poses), configured.covariance
    wrt_pose_error = configured.whitening(configured.linear.wrt_pose * POSE_ERROR)
    explained, log_ratio, added = np.empty(n), np.empty(n), np.empty((n, 6, 6))
    for group in configured.problem.observations.station_groups:
        K, A = wrt_pose_error[group.rows], configured.jacobian[group.rows]
        AK = np.swapaxes(A, 1, 2) @ K
        G = C @ AK
        M = np.eye(6) + np.swapaxes(K, 1, 2) @ K - np.swapaxes(AK, 1, 2) @ G
        Kr = np.einsum('sci,sc->si', K, configured.postfit_residuals[group.rows])
        minus_e = np.linalg.solve(M, Kr[..., None])
        explained[group.stations] = (Kr * minus_e[..., 0]).sum(axis=1)
        log_ratio[group.stations] = (explained[group.stations] - np.linalg.slogdet(M)[1]) / 2
        G_X = G[:, :6]  # of the transform
        h = G_X @ minus_e
        added[group.stations] = h @ np.swapaxes(h, 1, 2) + G_X @ np.linalg.solve(
            M, np.swapaxes(G_X, 1, 2))
    return explained, log_ratio, added
