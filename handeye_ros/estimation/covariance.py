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
from handeye_ros.data import Array, Term
from handeye_ros.estimation.basis import grid_over
from handeye_ros.estimation.blocks import with_columns
from handeye_ros.estimation.least_squares import chi2_sf
from handeye_ros.estimation.noise import covariance_parts, Noise
from handeye_ros.estimation.solve import Solution, solution_at
import numpy as np

POSE_ERROR = np.repeat([1e-3, 3e-3], 3)  # 1 sigma of a wrong station's pose error (m, rad)
ONE_WRONG, CORRECTED_ARM = 'one station wrong', 'corrected arm'  # names of added parts in a budget
PRIOR_ODDS_WRONG = 0.05  # prior odds of a station being wrong against all being right
SURE_ODDS = 100.0  # posterior odds of one station being wrong, from which it is dropped
SMALLEST_P = 0.2  # p-value of the other squares below which more than one is wrong


def with_possibly_wrong_station(solution: Solution, dropped: int) -> Solution:
    """
    Return a solution with its contamination, (10), and the station that is almost surely wrong.

    Between problem.many stations and twice as many the probabilities fade to 0. dropped: number of
    stations dropped as wrong, which make another wrong one likelier.
    """
    n = len(solution.problem.poses)
    weight = min(1.0, 2 - n / solution.problem.many)
    if weight <= 0:
        return solution
    configured = solution_at(solution.problem, solution.estimate, Noise())
    explained, log_odds, added = _each_station_wrong(configured)
    # the posterior: that each is the only wrong one, or that none is
    log_odds = log_odds + np.log(PRIOR_ODDS_WRONG + dropped / (n + dropped))
    most = max(0.0, float(log_odds.max()))
    odds = np.exp(log_odds - most)
    probability = weight * odds / (np.exp(-most) + odds.sum())
    # one that is almost surely wrong, while the others then fit
    worst = int(np.argmax(probability))
    freedom = max(configured.degrees_of_freedom - len(POSE_ERROR), 1)
    rest = chi2_sf(max(configured.sum_of_squares - explained[worst], 0.0), freedom)
    sure = probability[worst] > SURE_ODDS * (1 - probability[worst]) and rest > SMALLEST_P
    return replace(solution, added_covariances={ONE_WRONG: np.tensordot(probability, added, 1)},
                   probability_wrong=float(probability.sum()),
                   surely_wrong=worst if sure else None)


def _each_station_wrong(configured: Solution) -> tuple[Array, Array, Array]:
    """
    Return of each station, if its pose is wrong: squares explained, log odds, added covariance.

    Its whitened residuals are then r + J x + K e, with r those of the fit to all, x the change of
    the fit, of which the information is that of C, and e the error of the pose in sigmas of a
    wrong one, of unit covariance a priori. The least squares for a given e is x = -G e with
    G = C J'K. Without x, the information about e is A = 1 + K'K - K'J G, and the least squares
    e = -A^-1 K'r. So the sum of squares falls by r'K A^-1 K'r (n,), the log of the odds against
    all being right is half of this less log det A (n,), and the change of the transform is of the
    mean square h h' + G A^-1 G' (n, 6, 6), h = -G e, as (10) sums them.
    """
    n = len(configured.problem.poses)
    wrt_pose_error = configured.whitening(configured.linear.wrt_pose * POSE_ERROR)
    explained, log_odds, added = np.empty(n), np.empty(n), np.empty((n, 6, 6))
    for group in configured.problem.station_groups:
        i = configured.problem.observations.station[group.rows[:, 0]]
        K, J = wrt_pose_error[group.rows], configured.jacobian[group.rows]
        JK = np.swapaxes(J, 1, 2) @ K
        G = configured.covariance @ JK
        A = np.eye(6) + np.swapaxes(K, 1, 2) @ K - np.swapaxes(JK, 1, 2) @ G
        Kr = np.einsum('sci,sc->si', K, configured.postfit_residuals[group.rows])
        minus_e = np.linalg.solve(A, Kr[..., None])
        explained[i] = (Kr * minus_e[..., 0]).sum(axis=1)
        log_odds[i] = (explained[i] - np.linalg.slogdet(A)[1]) / 2
        G = G[:, :6]  # of the transform
        h = G @ minus_e
        added[i] = h @ np.swapaxes(h, 1, 2) + G @ np.linalg.solve(A, np.swapaxes(G, 1, 2))
    return explained, log_odds, added


def budget(solution: Solution) -> list[Term]:
    """
    Return what each cause contributes to the reported covariance of the transform, and all of it.

    White noise of sensor and poses, and each block by its name, are the exact parts of C in (5) at
    the conservative scales: with the gain C A', noise of covariance V gives (C A')V(C A')', and a
    block's parameters, of unit covariance, give C_xn C_nx. Then what (8), (10) and a corrected arm
    add to it.
    """
    conservative = solution.conservative
    parts = _of_noise(conservative)
    for block, columns in with_columns(conservative.blocks, conservative.unknowns):
        information = conservative.prior_information[columns]
        gain = conservative.covariance[:6, columns] * information ** 0.5
        parts[block.name] = gain @ gain.T
    shift = solution.conservative_shift
    parts |= {'prior scales': np.outer(shift, shift), **solution.added_covariances}
    parts['best-fit transform'] = (
        solution.transform_covariance - conservative.covariance[:6, :6] - np.outer(shift, shift)
        - sum(solution.added_covariances.values()))
    terms = [_term(solution, name, part) for name, part in parts.items()]
    return [*sorted((t for t in terms if t.mapped > 0), key=lambda t: -t.mapped),
            _term(solution, 'all', solution.transform_covariance)]


def _of_noise(conservative: Solution) -> dict[str, Array]:
    """Return the parts (6, 6) of C that come from the white errors of sensor and poses, (3)."""
    parts = {'sensor, white': np.zeros((6, 6)), 'poses, white': np.zeros((6, 6))}
    groups = conservative.problem.station_groups
    for group, root in zip(groups, conservative.whitening.roots, strict=True):
        V = covariance_parts(conservative.linear, group)
        V = V * conservative.noise.variance_factors[:len(V), None, None, None]
        J = conservative.jacobian[group.rows]
        gain = (J @ conservative.covariance[:, :6]).swapaxes(1, 2) @ root
        for name, some in zip(parts, (V[:3].sum(axis=0), V[3:].sum(axis=0)), strict=True):
            parts[name] += (gain @ some @ gain.swapaxes(1, 2)).sum(axis=0)
    return parts


def _term(solution: Solution, name: str, part: Array) -> Term:
    """Return the sigmas of a part (6, 6) of the covariance."""
    points = grid_over(solution.problem.observations.points, (-1, 0, 1))
    levers = points @ solution.estimate.X[:3, [0, 2]].T
    mapped = np.trace(se3.mapped_covariance(levers, part))
    squares = (np.trace(part[:3, :3]) / 3, np.trace(part[3:, 3:]) / 3, mapped)
    return Term(name, *(float(max(square, 0.0) ** 0.5) for square in squares))
