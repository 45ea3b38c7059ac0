"""Least squares over the transform and the target, the same for every method."""
from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.blocks import best_fit_motions, ParameterBlock, pose_corrections
from handeye_ros.estimation.jacobian import FactoredJacobian
from handeye_ros.estimation.linalg import FREE, inverse
from handeye_ros.estimation.linearise import Linear, Problem
from handeye_ros.estimation.model import Estimate
from handeye_ros.estimation.noise import (
    Noise,
    PRIOR_FREEDOM,
    total_covariance,
    whitening,
)
from handeye_ros.estimation.outliers import leave_own_out
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Solution:
    """
    An estimate with its residuals, covariance and statistics.

    white: (m,) whitened residuals minus the contribution of the blocks; columns: whitened
    derivatives by u unknowns (first six: X), then by q nuisance parameters in sigmas; covariance:
    (u + q, u + q) C of (5), sigmas at most LARGEST_STD; nuisance: (q,) estimates; blocks: their
    sigmas are tau times the configured ones; conservative: solution at conservative scales: its
    estimate moves too far, its covariance is realistic; contamination: (6, 6) of (10).
    """

    problem: Problem
    estimate: Estimate
    noise: Noise
    linear: Linear
    white: Array
    columns: FactoredJacobian
    covariance: Array
    nuisance: Array = field(default_factory=lambda: np.empty(0))
    blocks: tuple[ParameterBlock, ...] = ()
    conservative: Solution | None = None
    contamination: Array | None = None

    @cached_property
    def reported(self) -> Array:
        """
        Return the reported covariance (u, u) of the unknowns, (8).

        It covers the errors of both the mount's transform and the best-fit transform.
        """
        conservative = self.conservative
        if conservative is None:
            return self.covariance[:self.unknowns, :self.unknowns]
        away = se3.difference(conservative.estimate.X, self.estimate.X)
        reported = conservative.reported.copy()
        reported[:6, :6] = covering(reported[:6, :6] + np.outer(away, away),
                                    self._best_fit(conservative, away))
        if self.contamination is not None:
            reported[:6, :6] += self.contamination
        return reported

    def _best_fit(self, conservative: Solution, away: Array) -> Array:
        """Return the mean square (6, 6) of the best-fit transform about the estimate, (9)."""
        moving = best_fit_motions(conservative.linear, conservative.blocks)
        columns = np.hstack([np.eye(6, conservative.unknowns), moving])
        away = away + moving @ conservative.nuisance
        return np.asarray(columns @ conservative.covariance @ columns.T + np.outer(away, away))

    @property
    def unknowns(self) -> int:
        """Return the number of unknowns without the nuisance parameters."""
        return self.columns.count - len(self.nuisance)

    @property
    def jacobian(self) -> Array:
        """Return the dense whitened derivatives (m, u + q)."""
        return self.columns.dense

    @cached_property
    def information(self) -> Array:
        """Return the (u + q, u + q) information of residuals and priors."""
        prior = np.append(np.zeros(self.unknowns), np.ones(len(self.nuisance)))
        return np.asarray(self.columns.gram + np.diag(prior))

    @cached_property
    def ranks(self) -> NDArray[np.intp]:
        """
        Return the rank (n,) of each station's derivatives by the unknowns.

        Many points of one line have rank two: the offset and the direction of the line.
        """
        station = self.problem.observations.station
        ranks = np.zeros(len(self.problem.poses), dtype=np.intp)
        J = self.columns.local[:, :self.unknowns]
        J = J / np.maximum(np.linalg.norm(J, axis=0), 1e-300)
        for at in self.problem.stations:
            s = np.linalg.svd(J[at.rows], compute_uv=False)
            # smaller singular values are repeated information with other noise
            ranks[station[at.rows[:, 0]]] = (s > 1e-3 * s[:, :1]).sum(axis=1)
        return ranks

    @property
    def squares(self) -> float:
        """Return the sum of squares of residuals and nuisance parameters."""
        return float(self.white @ self.white + self.nuisance @ self.nuisance)

    @property
    def variance_factor(self) -> float:
        """Return the squared whitened residual per degree of freedom."""
        return self.squares / max(self.degrees_of_freedom, 1)

    @property
    def degrees_of_freedom(self) -> int:
        """Return the number of conditions less the number of unknowns."""
        return len(self.white) - self.unknowns

    @property
    def target_std(self) -> Array:
        """Return 1 sigma (k,) of the target's parameters, 0 for known ones."""
        if self.conservative is not None:
            return self.conservative.target_std
        std = np.zeros(len(self.problem.method.labels))
        variances = np.diag(self.covariance)
        std[self.problem.columns[6:] - 6] = np.sqrt(variances[6:self.unknowns])
        first = self.unknowns
        for block in self.blocks:
            if block.parameter is not None:
                std[block.parameter] = block.std * variances[first] ** 0.5
            first += block.count
        return std

    @property
    def redundancy(self) -> int:
        """
        Return the number of independent conditions in excess of the unknowns.

        A repeated pose adds no information; of very many poses only some are counted.
        """
        return int(self.ranks[self.problem.distinct].sum()) - self.unknowns

    @property
    def residual_rms(self) -> float:
        """Return the RMS (m) of the residuals before whitening."""
        return float(np.sqrt((self.linear.residuals ** 2).mean()))

    @property
    def expected_rms(self) -> float:
        """Return the expected RMS (m) of residuals for configured noise and nuisances."""
        total = sum(float(np.einsum('nii->', total_covariance(self.linear, at, Noise())))
                    for at in self.problem.stations)
        return float((total / len(self.linear.residuals)) ** 0.5)

    @property
    def deviance(self) -> float:
        """Return -2 log of the marginal likelihood, the prior of the noise factors included."""
        white = whitening(self.linear, self.noise)
        spread = -2 * sum(float(np.log(np.einsum('nii->ni', f)).sum()) for f in white.factors)
        factors = self.noise.factors
        prior = PRIOR_FREEDOM * float((np.log(factors) + 1 / factors - 1).sum())
        return float(spread + np.linalg.slogdet(self.information)[1] + self.squares + prior)

    def corrected_poses(self, nuisance: Array | None = None) -> Array:
        """
        Return the poses (n, 4, 4) without the estimated errors of the robot.

        nuisance: (n, q) parameters of the blocks at each pose, None: as estimated.
        """
        problem, estimated = self.problem, self.nuisance
        # the poses already include the blocks that retract
        inside = [np.full(b.count, float(b.retract is not None)) for b in self.blocks]
        values = (estimated if nuisance is None else nuisance) - estimated * np.concatenate(
            [[], *inside])
        errors, T = pose_corrections(problem, self.blocks, values), problem.robot_poses
        corrected = se3.transform(se3.exp_rotation(errors[:, 3:]) @ T[:, :3, :3],
                                  T[:, :3, 3] + errors[:, :3])
        return corrected if problem.in_hand else se3.inverse(corrected)

    def predictions(self, fold: NDArray[np.intp]) -> tuple[list[Estimate], Array]:
        """
        Return the estimate without each fold of stations, to first order.

        fold: (n,) fold of each station, from 0. Also returns the poses (n, 4, 4), corrected by the
        robot's smooth error as estimated from the other folds.
        """
        folds = np.arange(fold.max() + 1)
        steps = _steps_without_one(self)[np.argsort(fold)] if len(folds) == len(fold) else (
            np.array([_step_without(self, np.flatnonzero(fold == k)) for k in folds]))
        u = self.unknowns
        return ([self.problem.retracted(self.estimate, step) for step in steps[:, :u]],
                self.corrected_poses(self.nuisance + steps[fold, u:]))


def columns_of(problem: Problem, own: Array, axes: int) -> FactoredJacobian:
    """Return the Jacobian of own (m, c + axes), whose last axes columns are factored."""
    nothing = np.empty((len(problem.poses), 0))
    shared, both = (problem.smooth, problem.smooth_products) if axes else (nothing, nothing)
    return FactoredJacobian(own, shared, both, axes, [at.rows for at in problem.stations],
                            problem.observations.station)


def station_statistic(solution: Solution) -> tuple[Array, NDArray[np.intp]]:
    """
    Return the squared leave-one-out residual of each station, and its degrees of freedom.

    It is whitened, and to first order from the fit without the station: chi-squared distributed
    when the station is good.
    """
    station, n = solution.problem.observations.station, len(solution.problem.poses)
    statistic = np.zeros(n)
    for rows in solution.columns.rows:
        r = solution.white[rows]
        explained = solution.columns.predicted_covariance(solution.covariance, rows)
        left_out = leave_own_out(explained, r)
        statistic[station[rows[:, 0]]] = (r * left_out).sum(axis=1)
    return statistic, np.bincount(station, minlength=n)


def _steps_without_one(solution: Solution) -> Array:
    """Return the changes (n, u + q) of the unknowns when each station is left out."""
    columns, station = solution.columns, solution.problem.observations.station
    slopes = np.zeros((len(solution.problem.poses), columns.count))
    for rows in columns.rows:
        left_out = leave_own_out(columns.predicted_covariance(solution.covariance, rows),
                                 solution.white[rows])
        slopes[station[rows[:, 0]]] = columns.gradients(left_out, rows)
    return slopes @ solution.covariance


def _step_without(solution: Solution, stations: NDArray[np.intp]) -> Array:
    """Return the change (u + q,) of the unknowns when some stations are left out."""
    columns, part = solution.columns, solution.columns.of(stations)
    left = solution.information - columns.gram_of(part)
    return inverse(left) @ columns.gradient_of(solution.white, part)


def covering(first: Array, second: Array) -> Array:
    """Return the smallest covariance (k, k) not below either of two in any direction, (8)."""
    std = np.sqrt(np.diag(first))
    values, vectors = np.linalg.eigh(first / np.outer(std, std))
    roots = np.sqrt(np.maximum(values, FREE))
    root, inverse = std[:, None] * vectors * roots, (vectors / roots).T / std
    values, vectors = np.linalg.eigh(inverse @ second @ inverse.T)
    along = root @ vectors
    return np.asarray((along * np.maximum(values, 1.0)) @ along.T)
