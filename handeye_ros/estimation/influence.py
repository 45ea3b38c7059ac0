"""
What one station, or a fold of them, does to the answer, to first order.

The answer without it, and the answer if it is wrong, (10) of estimator.md. That a station is
wrong, by no more than a slip of its pose, and that all are right are weighed against each other
(Box and Tiao 1968, Biometrika 55:119), with noise and blocks as configured: were these grown until
they explain it, a wrong station would hide.
"""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros.data import Array
from handeye_ros.estimation.linalg import inverse
from handeye_ros.estimation.model import Estimate
from handeye_ros.estimation.noise import Noise, whitening
from handeye_ros.estimation.outliers import chi2_sf, leave_own_out
from handeye_ros.estimation.posterior import evaluated
from handeye_ros.estimation.solution import corrected_poses, retracted, Solution
import numpy as np
from numpy.typing import NDArray

MANY = 200  # stations from which on this fades, to nothing at twice as many: under 1 % of a sigma
SLIPPED = np.repeat([1e-3, 3e-3], 3)  # by how much a wrong one is (m, rad; 1 sigma of each axis)
WRONG = 0.05  # share of stations that are wrong
SURE = 100.0  # times as likely as anything else is that the station is wrong which is
EXPLAINED = 0.2  # chance of the squares of the others, less than which more than one is wrong


@dataclass(frozen=True, eq=False)
class Contamination:
    """
    Of each station the chance (n,) that it is wrong, and by how much it then moves the transform.

    moves: (n, 6), covariances: (n, 6, 6) of the transform if so, beyond that if not; rest: (n,)
    the chance of what then remains of the squared residuals.
    """

    chance: Array
    shifts: Array
    covariances: Array
    rest: Array

    @property
    def worst(self) -> int | None:
        """Return the station that is surely wrong, all others being right, None if none is."""
        worst = int(np.argmax(self.chance))
        conclusive = self.chance[worst] > SURE * (1 - self.chance[worst])
        return worst if conclusive and self.rest[worst] > EXPLAINED else None

    @property
    def of_any(self) -> float:
        """Return the chance that one of the stations is wrong."""
        return float(self.chance.sum())

    @property
    def covariance(self) -> Array:
        """Return (6, 6) by what the covariance of the transform has to grow, (10)."""
        moved = self.covariances + self.shifts[:, :, None] * self.shifts[:, None, :]
        return np.asarray(np.tensordot(self.chance, moved, 1))


def contamination(solution: Solution, dropped: int) -> Contamination | None:
    """
    Return which station of a solution may be wrong, None of very many: this fades with them.

    dropped: how many are known to have been wrong, which makes another one likelier.
    """
    n = len(solution.problem.poses)
    weight = min(1.0, 2 - n / MANY)
    if weight <= 0:
        return None
    known = evaluated(solution.problem, solution.estimate, Noise())
    white = whitening(known.problem, known.linear, known.noise)
    slips = white(known.linear.by_pose * SLIPPED)
    log_odds, explained = np.empty((2, n))
    shifts, covariances = np.empty((n, 6)), np.empty((n, 6, 6))
    for at in known.problem.stations:
        i = known.problem.observations.station[at.rows[:, 0]]
        K, J = slips[at.rows], known.jacobian[at.rows]
        across = np.swapaxes(J, 1, 2) @ K
        moved = known.covariance @ across
        inside = np.eye(6) + np.swapaxes(K, 1, 2) @ K - np.swapaxes(across, 1, 2) @ moved
        slope = np.einsum('sci,sc->si', K, known.white[at.rows])
        size = np.linalg.solve(inside, slope[..., None])
        explained[i] = (slope * size[..., 0]).sum(axis=1)
        log_odds[i] = (explained[i] - np.linalg.slogdet(inside)[1]) / 2
        to_transform = moved[:, :6]
        shifts[i] = (to_transform @ size)[..., 0]
        covariances[i] = to_transform @ np.linalg.solve(inside, np.swapaxes(to_transform, 1, 2))
    log_odds += np.log(WRONG + dropped / (n + dropped))
    freedom = max(known.degrees_of_freedom - len(SLIPPED), 1)
    return Contamination(weight * _probabilities(log_odds), shifts, covariances,
                         chi2_sf(np.maximum(known.squares - explained, 0.0), freedom))


def _probabilities(log_odds: Array) -> Array:
    """Return the chances (n,) of what excludes each other, by the odds against none of them."""
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
    return ([retracted(problem, estimate, step) for step in steps[:, :u]],
            corrected_poses(solution, solution.nuisance + steps[fold, u:]))


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
