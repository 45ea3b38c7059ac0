"""What the other stations make of one, or of a fold of them, to first order."""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.estimation import influence
from handeye_ros.estimation.model import Estimate
from handeye_ros.estimation.solution import corrected_poses, retracted, Solution
import numpy as np
from numpy.typing import NDArray


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
        left_out = influence.leave_own_out(columns.predicted_covariance(solution.covariance, rows),
                                           solution.white[rows])
        slopes[station[rows[:, 0]]] = columns.gradients(left_out, rows)
    return slopes @ solution.covariance


def _step_without(solution: Solution, stations: NDArray[np.intp]) -> Array:
    """Return by how much the unknowns (u + q,) differ without some stations."""
    columns, part = solution.columns, solution.columns.of(stations)
    rows = np.concatenate([some.ravel() for some in part])
    if len(rows) < columns.count:
        return influence.step_without(solution.white[rows], columns.dense_rows(rows),
                                      solution.covariance)
    return influence.step_without_many(solution.information, columns.gram_of(part),
                                       columns.gradient_of(solution.white, part))
