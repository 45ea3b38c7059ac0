"""
What a robot whose error is systematic does to the uncertainty.

A real robot's error varies smoothly over its workspace: stations near each other share it, so
part of it hides in the answer instead of the residuals. Where the residuals show more robot
error than configured, the surplus is taken to be of that kind, and the covariance is that of
the estimate under it (a sandwich: the weights are kept, the true covariance is in between).
"""
from __future__ import annotations

from dataclasses import replace

from handeye_ros.data import Array
from handeye_ros.estimation.solve import Solution
from handeye_ros.estimation.weights import whitening
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

ALIKE_POSITION = 0.4  # poses this far apart (m), or turned this far (rad), share little error
ALIKE_ROTATION = 0.7
CONFIDENCE = 0.8  # that the systematic error is not larger than assumed
MANY_STATIONS = 300


def with_systematic_error(solution: Solution) -> Solution:
    """Return the solution with a covariance that also holds for a smooth robot error."""
    if solution.noise.robot <= 1.0:
        return solution
    H = solution.covariance
    shared = likeness(solution.problem.poses)
    F = _carried_pose_errors(solution)  # (n, 6, u): pose errors of unit size to the estimate
    systematic = np.einsum('iau,ij,jav->uv', F, shared, F, optimize=True)
    total, hidden = _pose_traces(solution), float(np.trace(np.linalg.solve(H, systematic)))
    surplus = (1.0 - 1.0 / solution.noise.robot) * _visible(solution)
    amplitude = caution(solution, shared) * surplus / max(total - hidden, 1e-3 * total)
    independent = H - (1.0 - 1.0 / solution.noise.robot) * np.einsum('iau,iav->uv', F, F)
    stated = independent + amplitude * systematic
    return replace(solution, stated=np.asarray(0.5 * (stated + stated.T)))


def caution(solution: Solution, shared: Array) -> float:
    """
    Return the factor from the amplitude's estimate to the upper end of its interval.

    A smooth error gives the residuals few degrees of freedom (Satterthwaite's number), so its
    amplitude is known badly; many stations make this negligible.
    """
    if len(shared) > MANY_STATIONS:
        return 1.0
    station = solution.problem.observations.station
    G, J = _white_pose_errors(solution), solution.jacobian
    C = (G @ G.T) * shared[np.ix_(station, station)]
    visible = C - J @ (solution.covariance @ (J.T @ C))
    freedom = np.trace(visible) ** 2 / np.einsum('ij,ji->', visible, visible)
    return float(freedom / chi2.ppf(1.0 - CONFIDENCE, freedom))


def likeness(poses: Array) -> Array:
    """Return the correlation (n, n) of the systematic errors at poses (n, 4, 4)."""
    positions = poses[:, :3, 3]
    rotations = Rotation.from_matrix(poses[:, :3, :3])
    vectors = (rotations.mean().inv() * rotations).as_rotvec()
    place = np.concatenate([positions / ALIKE_POSITION, vectors / ALIKE_ROTATION], axis=1)
    squared = ((place[:, None] - place[None]) ** 2).sum(axis=2)
    return np.asarray(np.exp(-0.5 * squared))


def _white_pose_errors(solution: Solution) -> Array:
    """Return the whitened derivative (m, 6) by pose errors of one sigma of the present noise."""
    noise = solution.problem.config.noise
    sigma = np.repeat([noise.robot_translation, noise.robot_rotation], 3)
    white = whitening(solution.problem, solution.linear, solution.noise)
    return white(solution.linear.by_pose * sigma * solution.noise.robot ** 0.5)


def _carried_pose_errors(solution: Solution) -> Array:
    G, J = _white_pose_errors(solution), solution.jacobian
    station, n = solution.problem.observations.station, len(solution.problem.poses)
    F = np.zeros((n, 6, J.shape[1]))
    np.add.at(F, station, np.einsum('ma,mu->mau', G, J @ solution.covariance))
    return F


def _pose_traces(solution: Solution) -> float:
    """Return the trace of the whitened covariance that pose errors make."""
    return float((_white_pose_errors(solution) ** 2).sum())


def _visible(solution: Solution) -> float:
    """Return how much of independent pose errors the residuals show."""
    F = _carried_pose_errors(solution)
    hidden = np.einsum('iau,iav->uv', F, F)
    return _pose_traces(solution) - float(np.trace(np.linalg.solve(solution.covariance, hidden)))
