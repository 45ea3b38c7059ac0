"""
What one station, or a fold of them, does to the answer, to first order.

The answer without it, and the answer if it is wrong, (10) of estimator.md. That a station is
wrong, by a small error of its pose, and that all are right are weighed against each other (Box and
Tiao 1968, Biometrika 55:119), with noise and blocks as configured: were these grown until they
explain it, a wrong station would hide.
"""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros.data import Array
from handeye_ros.estimation.linalg import inverse
from handeye_ros.estimation.linearise import MANY
from handeye_ros.estimation.model import Estimate
from handeye_ros.estimation.noise import Noise, whitening
from handeye_ros.estimation.outliers import chi2_sf, leave_own_out
from handeye_ros.estimation.posterior import evaluated
from handeye_ros.estimation.solution import Solution
import numpy as np
from numpy.typing import NDArray

POSE_ERROR = np.repeat([1e-3, 3e-3], 3)  # of a wrong station (m, rad; 1 sigma of each axis)
WRONG = 0.05  # share of stations that are wrong
SURE = 100.0  # times as likely as anything else is that the station is wrong which is
EXPLAINED = 0.2  # p-value of the squares of the others, below which more than one is wrong


@dataclass(frozen=True, eq=False)
class Contamination:
    """
    The probability of each station being wrong, and by how much it then moves the transform.

    Of (10) probability: (n,) p_i; shifts: (n, 6) m_i; covariances: (n, 6, 6) S_i; rest:
    (n,) the p-value of the squared residuals that then remain.
    """

    probability: Array
    shifts: Array
    covariances: Array
    rest: Array

    @property
    def worst(self) -> int | None:
        """Return the station that is surely wrong, all others being right, None if none is."""
        worst = int(np.argmax(self.probability))
        conclusive = self.probability[worst] > SURE * (1 - self.probability[worst])
        return worst if conclusive and self.rest[worst] > EXPLAINED else None

    @property
    def of_any(self) -> float:
        """Return the probability that one of the stations is wrong."""
        return float(self.probability.sum())

    @property
    def covariance(self) -> Array:
        """Return the term (6, 6) of the covariance of the transform, (10)."""
        moved = self.covariances + self.shifts[:, :, None] * self.shifts[:, None, :]
        return np.asarray(np.tensordot(self.probability, moved, 1))


def contamination(solution: Solution, dropped: int) -> Contamination | None:
    """
    Return which station of a solution may be wrong, None of very many.

    From MANY on this fades, to nothing at twice as many. dropped: how many are known to have
    been wrong, which makes another one likelier.
    """
    n = len(solution.problem.poses)
    weight = min(1.0, 2 - n / MANY)
    if weight <= 0:
        return None
    configured = evaluated(solution.problem, solution.estimate, Noise())
    white = whitening(configured.linear, configured.noise)
    wrong = white(configured.linear.by_pose * POSE_ERROR)
    log_odds, explained = np.empty((2, n))
    shifts, covariances = np.empty((n, 6)), np.empty((n, 6, 6))
    for at in configured.problem.stations:
        i = configured.problem.observations.station[at.rows[:, 0]]
        K, J = wrong[at.rows], configured.jacobian[at.rows]
        across = np.swapaxes(J, 1, 2) @ K
        moved = configured.covariance @ across
        inside = np.eye(6) + np.swapaxes(K, 1, 2) @ K - np.swapaxes(across, 1, 2) @ moved
        slope = np.einsum('sci,sc->si', K, configured.white[at.rows])
        size = np.linalg.solve(inside, slope[..., None])
        explained[i] = (slope * size[..., 0]).sum(axis=1)
        log_odds[i] = (explained[i] - np.linalg.slogdet(inside)[1]) / 2
        to_transform = moved[:, :6]
        shifts[i] = (to_transform @ size)[..., 0]
        covariances[i] = to_transform @ np.linalg.solve(inside, np.swapaxes(to_transform, 1, 2))
    log_odds += np.log(WRONG + dropped / (n + dropped))
    freedom = max(configured.degrees_of_freedom - len(POSE_ERROR), 1)
    return Contamination(weight * _probabilities(log_odds), shifts, covariances,
                         chi2_sf(np.maximum(configured.squares - explained, 0.0), freedom))


def _probabilities(log_odds: Array) -> Array:
    """Return the probabilities (n,) of exclusive cases, by their log odds against none of them."""
    most = max(0.0, float(log_odds.max()))
    odds = np.exp(log_odds - most)
    return np.asarray(odds / (np.exp(-most) + odds.sum()))


def predictions(solution: Solution, fold: NDArray[np.intp]) -> tuple[list[Estimate], Array]:
    """
    Return the estimates from all stations but those of a fold, for each fold, to first order.

    fold: (n,) from 0, that each station is of. And the poses (n, 4, 4) of the stations without
    the smooth error of the robot that those of the other folds show.
    """
    problem, estimate, u = solution.problem, solution.estimate, solution.unknowns
    folds = np.arange(fold.max() + 1)
    steps = _steps_without_one(solution)[np.argsort(fold)] if len(folds) == len(fold) else (
        np.array([_step_without(solution, np.flatnonzero(fold == k)) for k in folds]))
    return ([problem.retracted(estimate, step) for step in steps[:, :u]],
            solution.corrected_poses(solution.nuisance + steps[fold, u:]))


def _steps_without_one(solution: Solution) -> Array:
    """Return by how much the unknowns (n, u + q) differ without each of the stations."""
    columns, station = solution.columns, solution.problem.observations.station
    slopes = np.zeros((len(solution.problem.poses), columns.count))
    for rows in columns.rows:
        left_out = leave_own_out(columns.predicted_covariance(solution.covariance, rows),
                                 solution.white[rows])
        slopes[station[rows[:, 0]]] = columns.gradients(left_out, rows)
    return slopes @ solution.covariance


def _step_without(solution: Solution, stations: NDArray[np.intp]) -> Array:
    """Return by how much the unknowns (u + q,) differ without some stations."""
    columns, part = solution.columns, solution.columns.of(stations)
    left = solution.information - columns.gram_of(part)
    return inverse(left) @ columns.gradient_of(solution.white, part)
