# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What the reported covariance consists of, and its part for a station that may be wrong, (10).

With few stations, a wrong one may not show in the residuals. The hypotheses that one station has a
small pose error and that all are right are compared by their odds (Box and Tiao 1968, Biometrika
55:119). Noise and blocks stay as configured: if they could grow with the misfit, a wrong station
would be hidden.
"""
from __future__ import annotations

from dataclasses import replace

from handeye_ros import se3
from handeye_ros.data import Array, BudgetTerm
from handeye_ros.estimation.basis import grid_over
from handeye_ros.estimation.blocks import blocks_with_columns
from handeye_ros.estimation.least_squares import chi2_sf
from handeye_ros.estimation.noise import covariance_parts, NoiseModel, POSE_INDEX
from handeye_ros.estimation.posterior import Posterior, posterior_at
from handeye_ros.estimation.solution import Solution
import numpy as np

POSE_ERROR = np.repeat([1e-3, 3e-3], 3)  # 1 sigma of a wrong station's pose error (m, rad)
ONE_WRONG, CORRECTED_ARM = 'one station wrong', 'corrected arm'  # added parts in a budget
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
                   surely_wrong_places=(worst,) if sure else ())


def _each_station_wrong(configured: Posterior) -> tuple[Array, Array, Array]:
    """
    Return what a wrong pose would mean, for each station.

    (n,) by how much the sum of squares falls if that station's pose is wrong; (n,) the log of the
    likelihood ratio of this against all being right; (n, 6, 6) the mean square of the change of
    the transform, Sigma_i + h_i h_i' in (10).

    With r the whitened residuals of the fit to all, those of a fit with one wrong pose are
    r + J x + K e: e is the error of the pose, of unit covariance a priori, and x the change of the
    fit (with the covariance C). For a given e, x = -G e with G = C J'K. Without x, e has the
    information A = 1 + K'K - K'J G and the estimate e = -A^-1 K'r. So the squares fall by
    r'K A^-1 K'r, the log ratio is half of (this less log det A), h = -G e and
    Sigma_i = G A^-1 G'.
    """
    n, C = len(configured.problem.poses), configured.covariance
    wrt_pose_error = configured.whitening(configured.linear.wrt_pose * POSE_ERROR)
    explained, log_ratio, added = np.empty(n), np.empty(n), np.empty((n, 6, 6))
    for group in configured.problem.observations.station_groups:
        K, J = wrt_pose_error[group.rows], configured.jacobian[group.rows]
        JK = np.swapaxes(J, 1, 2) @ K
        G = C @ JK
        A = np.eye(6) + np.swapaxes(K, 1, 2) @ K - np.swapaxes(JK, 1, 2) @ G
        Kr = np.einsum('sci,sc->si', K, configured.postfit_residuals[group.rows])
        minus_e = np.linalg.solve(A, Kr[..., None])
        explained[group.stations] = (Kr * minus_e[..., 0]).sum(axis=1)
        log_ratio[group.stations] = (explained[group.stations] - np.linalg.slogdet(A)[1]) / 2
        G_X = G[:, :6]  # of the transform
        h = G_X @ minus_e
        added[group.stations] = h @ np.swapaxes(h, 1, 2) + G_X @ np.linalg.solve(
            A, np.swapaxes(G_X, 1, 2))
    return explained, log_ratio, added


def budget(solution: Solution) -> list[BudgetTerm]:
    """
    Return what each cause contributes to the reported covariance of the transform, and the total.

    White noise of sensor and poses, and each block by its name, are the exact parts of C in (5) at
    the taus for the report: whitened noise of covariance V gives (C A')V(C A')', and the
    parameters of a block, with the prior information 1/tau^2, give C_xn C_nx / tau^2. Then what
    (8), (10) and a corrected arm add to it. `best-fit transform` is the remainder, what (9)
    changes. A part without a positive variance of mapped points is left out.
    """
    reported = solution.report_posterior
    parts = _parts_of_noise(reported)
    for block, columns in blocks_with_columns(reported.blocks, reported.unknown_count):
        C_xn = reported.covariance[:6, columns]
        parts[block.name] = C_xn * reported.prior_information[columns] @ C_xn.T
    shift = np.outer(solution.shift_for_report, solution.shift_for_report)
    parts |= {'prior scales': shift, **solution.added_covariances}
    parts['best-fit transform'] = (
        solution.transform_covariance - reported.covariance[:6, :6] - shift
        - sum(solution.added_covariances.values()))
    terms = [_term(solution, name, part) for name, part in parts.items()]
    return [*sorted((term for term in terms if term.mapped > 0), key=lambda term: -term.mapped),
            _term(solution, 'all', solution.transform_covariance)]


def _parts_of_noise(reported: Posterior) -> dict[str, Array]:
    """Return the parts (6, 6) of C that come from the white errors of sensor and poses, (3)."""
    parts = {'sensor, white': np.zeros((6, 6)), 'poses, white': np.zeros((6, 6))}
    groups = reported.problem.observations.station_groups
    for group, root in zip(groups, reported.whitening.roots, strict=True):
        V = covariance_parts(reported.linear, group)
        V = V * reported.noise.variance_factors[:len(V), None, None, None]
        A = reported.jacobian[group.rows]
        gain = (A @ reported.covariance[:, :6]).swapaxes(1, 2) @ root  # of residuals in m
        for name, V_parts in zip(parts, np.split(V, [POSE_INDEX]), strict=True):
            parts[name] += (gain @ V_parts.sum(axis=0) @ gain.swapaxes(1, 2)).sum(axis=0)
    return parts


def _term(solution: Solution, name: str, part: Array) -> BudgetTerm:
    """Return the sigmas of a part (6, 6) of the covariance."""
    points = grid_over(solution.problem.observations.points, (-1, 0, 1))
    levers = points @ solution.estimate.X[:3, [0, 2]].T
    mapped = np.trace(se3.mapped_covariance(levers, part))
    squares = (np.trace(part[:3, :3]) / 3, np.trace(part[3:, 3:]) / 3, mapped)
    return BudgetTerm(name, *(float(max(square, 0.0) ** 0.5) for square in squares))
