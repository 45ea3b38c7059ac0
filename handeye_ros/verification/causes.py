# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Likelihoods of what changed since a calibration: nothing, target, sensor, or robot.

r = g(p; target) are the residuals of a recording at the answer of the calibration. With nothing
changed, r = G dX + J dη + e: dX, dη are the errors of the calibration's transform and target with
their joint covariance, e is the noise. A moved target adds T m, a moved sensor G m, m a twist; a
changed robot adds an error of each pose, smooth over the poses or white. Each has a normal prior,
averaged over SCALES, so each cause has a marginal likelihood. A change is reported if the causes
together are EVIDENCE times as likely as none: by Markov's inequality the probability of a false
alarm is at most 1 / EVIDENCE (Wald 1945).
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import chi2_sf
from handeye_ros.estimation.problem import Conditions, Target
from handeye_ros.frames import in_mount
from handeye_ros.targets.common import edges_of
from handeye_ros.verification import fixed_fit
from handeye_ros.verification.fixed_fit import by_calibration
from handeye_ros.verification.shapes import StationSet
import numpy as np
from numpy.typing import NDArray

EVIDENCE = 100.0
SCALES = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)  # m: how far something moves, a priori
LEVER = 0.1  # m: a scale over it is that of a turn
SMOOTH_ANGLE, SMOOTH_DISTANCE = 1.5, 0.9  # rad, m: over which an error of the robot is alike
ITERATIONS = 6
SMOOTHNESS = (1.0, 2.0)  # times as far; bench/verify.py --check: one joint's error reaches further
RANK = 1e-9
OUTLIER = 0.01  # probability that any good stop is left out
MOST_OUTLIERS = 0.15  # of the stops
STILL = np.zeros(6)  # no move


@dataclass(frozen=True, eq=False)
class Comparison:
    """
    A recording with the calibration that it is compared with.

    X (4, 4), state (s,): calibrated sensor plane in the mount, and calibrated target; covariance
    (6 + k, 6 + k): their joint covariance; noise_scale: factor of the stated noise.
    """

    method: Target
    stations: StationSet
    X: Array
    state: Array
    covariance: Array
    config: Config
    noise_scale: float = 1.0

    @cached_property
    def points(self) -> Array:
        """Return the positions (m, 3) of the observed points in the base."""
        return self.stations.points(self.X)

    def conditions(self, p: Array) -> Conditions:
        """Return residuals and derivatives of points p (m, 3) in the base."""
        return self.method.conditions(p, self.stations.observations.kind, self.state, self.config)


@dataclass(frozen=True, eq=False)
class Rows:
    """
    Whitened residuals r (m,) with derivatives, reduced to a few rows per station.

    calibration (m, c): derivatives by the calibration's errors, in units of 1 sigma; target,
    sensor (m, 6): by a move of these; robot (m, 6): by the error of the pose of its station (m,).
    constant: of the logarithm of the likelihood.
    """

    r: Array
    calibration: Array
    target: Array
    sensor: Array
    robot: Array
    station: NDArray[np.intp]
    constant: float

    @cached_property
    def unchanged(self) -> Array:
        """Return the covariance (m, m) of residuals without a change."""
        return np.asarray(np.eye(len(self.r)) + self.calibration @ self.calibration.T)

    def likelihood(self, added: Array, r: Array | None = None) -> float:
        """Return the log marginal likelihood; added: covariance (m, m) of a change."""
        factor = np.linalg.cholesky(self.unchanged + added)
        z = np.linalg.solve(factor, self.r if r is None else r)
        return float(-0.5 * z @ z - np.log(np.diag(factor)).sum() + self.constant)


@dataclass(frozen=True, eq=False)
class Cause:
    """Log likelihood, most likely move (6,) and its largest displacement of a point (m)."""

    name: str
    likelihood: float
    move: Array
    displacement: float
    displacement_std: float

    @property
    def size(self) -> tuple[float, float]:
        """Return shift (m) and turn (rad) of the move."""
        return float(np.linalg.norm(self.move[:3])), float(np.linalg.norm(self.move[3:]))


def rows_at(comparison: Comparison, cause: str = '', move: Array = STILL) -> Rows:
    """Return the residuals for a move of the target or the sensor."""
    X = se3.perturb(comparison.X, move) if cause == 'sensor' else comparison.X
    stations, obs = comparison.stations, comparison.stations.observations
    points = p = stations.points(X)
    centre, noise = comparison.points.mean(axis=0), comparison.config.noise
    back = se3.exp_rotation(-move[3:])
    if cause == 'target':
        p = (p - centre - move[:3]) @ back.T + centre
    conditions = comparison.conditions(p)
    by_p = conditions.dg_dp @ back if cause == 'target' else conditions.dg_dp
    G = np.einsum('mi,mij->mj', by_p, by_calibration(stations, X))  # by the error dX
    T = np.hstack([by_p, se3.cross(p - centre, by_p)])
    E = np.hstack([by_p, se3.cross(points - stations.poses[obs.station, :3, 3], by_p)])
    root = fixed_fit.root_of(comparison.covariance)
    by_errors = np.hstack([np.hstack([G, conditions.dg_dtarget]) @ root,
                           _setbacks(comparison, X, by_p)])
    # the error of the sensor's field differs from stop to stop, as that of the pose does
    blocks = fixed_fit.noise_factors(stations, X, by_p, noise, noise.distortion)
    columns = np.hstack([conditions.g[:, None], by_errors, T, -G, E])
    columns = fixed_fit.white(blocks, columns) / comparison.noise_scale
    constant = -sum(float(np.log(np.diag(factor)).sum()) for _, factor in blocks)
    reduced, numbers = [], []
    for number in np.unique(obs.station):
        rows = columns[obs.station == number]
        U, s, _ = np.linalg.svd(rows[:, 1:], full_matrices=False)
        few = U[:, s > RANK * s[0]].T @ rows
        reduced.append(few)
        numbers.append(np.full(len(few), number))
        constant -= 0.5 * float(rows[:, 0] @ rows[:, 0] - few[:, 0] @ few[:, 0])
    r, by_errors, target, sensor, robot = np.split(
        np.concatenate(reduced), np.cumsum([1, by_errors.shape[1], 6, 6]), axis=1)
    return Rows(r[:, 0], by_errors, target, sensor, robot, np.concatenate(numbers), constant)


def _setbacks(comparison: Comparison, X: Array, by_p: Array) -> Array:
    """Return the set-backs (m, e) of the ends of each kind at each edge, 1 sigma."""
    obs = edges_of(comparison.stations.observations)
    R = comparison.stations.poses[obs.station, :3, :3]
    out = np.einsum('mi,mij,jk,mk->m', by_p, R, X[:3, [0, 2]], obs.outward)
    groups = {(int(k), int(e)) for k, e in zip(obs.kind, obs.end, strict=True) if e}
    columns = [np.where((obs.kind == k) & (obs.end == e), out, 0.0) for k, e in sorted(groups)]
    return comparison.config.target.setback_std * np.reshape(columns, (-1, len(out))).T


def agreeing(comparison: Comparison) -> tuple[Comparison, list[int]]:
    """
    Return the comparison without stops that contradict the others, and their indices.

    By their leave-one-out residuals, with target and sensor free to have moved.
    """
    kept, left_out = comparison, list[int]()
    max_outliers = int(MOST_OUTLIERS * len(np.unique(comparison.stations.observations.station)))
    while len(left_out) < max_outliers:
        rows = rows_at(kept)
        D, P = np.hstack([rows.target, rows.sensor]), np.tile(_prior(SCALES[-1]), 2)
        W = np.linalg.inv(rows.unchanged + (D * P) @ D.T)
        p = dict[int, float]()
        for k in np.unique(rows.station).tolist():
            members = np.flatnonzero(rows.station == k)
            residual = W[members] @ rows.r
            square = residual @ np.linalg.solve(W[np.ix_(members, members)], residual)
            p[k] = float(chi2_sf(square, len(members)))
        worst = min(p, key=p.__getitem__)
        if p[worst] * len(p) > OUTLIER:
            break
        left_out.append(worst)
        kept = replace(comparison, stations=comparison.stations.without(left_out))
    return kept, left_out


def causes(comparison: Comparison) -> tuple[float, tuple[Cause, ...]]:
    """Return the log likelihood of no change, and the causes."""
    rows = rows_at(comparison)
    unchanged = rows.likelihood(np.zeros((len(rows.r),) * 2))
    return unchanged, (_move_cause(comparison, 'target'), _move_cause(comparison, 'sensor'),
                       _robot_cause(comparison, rows))


def _prior(scale: float) -> Array:
    return np.repeat([scale, scale / LEVER], 3) ** 2


def _move_cause(comparison: Comparison, name: str) -> Cause:
    """Return the cause of a moved target or sensor."""
    move, scale = STILL, SCALES[-1]
    for _ in range(ITERATIONS):
        rows = rows_at(comparison, name, move)
        D = getattr(rows, name)
        gain = D.T @ np.linalg.inv(rows.unchanged)
        C = np.linalg.inv(gain @ D + np.diag(1 / _prior(scale)))
        linear = rows.r + D @ move
        move = C @ gain @ linear
        likelihood = [rows.likelihood((D * _prior(s)) @ D.T, linear) for s in SCALES]
        scale = SCALES[int(np.argmax(likelihood))]
    by_move = by_calibration(comparison.stations, comparison.X)
    if name == 'target':  # it turns about the middle of its points
        offset = comparison.points - comparison.points.mean(axis=0)
        by_move = np.concatenate([np.broadcast_to(np.eye(3), by_move[..., 3:].shape),
                                  -se3.skew(offset)], axis=2)
    displacements = np.linalg.norm(by_move @ move, axis=1)
    worst = int(np.argmax(displacements))
    std = np.sqrt(np.trace(by_move[worst] @ C @ by_move[worst].T))
    return Cause(name, float(np.logaddexp.reduce(likelihood) - np.log(len(SCALES))), move,
                 float(displacements[worst]), float(std))


def _robot_cause(comparison: Comparison, rows: Rows) -> Cause:
    """Return the cause of pose errors: smooth in base or flange, or white."""
    # the flange in the base again
    T = in_mount(comparison.stations.poses[rows.station], comparison.config)
    away = np.linalg.norm(T[:, None, :3, 3] - T[None, :, :3, 3], axis=-1) / SMOOTH_DISTANCE
    cosine = (np.einsum('aij,bij->ab', T[:, :3, :3], T[:, :3, :3]) - 1) / 2
    square = away ** 2 + 2 * (1 - cosine) / SMOOTH_ANGLE ** 2  # of the chord: positive definite
    smooth, smoother = (np.exp(-0.5 * square / times ** 2) for times in SMOOTHNESS)
    kernels = ((rows.robot, smooth), (rows.robot, smoother), (rows.sensor, smoother),
               (rows.robot, rows.station[:, None] == rows.station))
    likelihood = [rows.likelihood((D * _prior(s)) @ D.T * kernel) for s in SCALES
                  for D, kernel in kernels]
    return Cause('robot', float(np.logaddexp.reduce(likelihood) - np.log(len(likelihood))), STILL,
                 0.0, 0.0)


def smallest_moves(comparison: Comparison, name: str) -> tuple[Array, Array]:
    """
    Return axes (3, 3), as rows, and the smallest detectable shifts (3,) along them.

    Of the target in the base, of the sensor in the flange; the smallest first, infinite where
    none would show.
    """
    rows = rows_at(comparison)
    D = getattr(rows, name)
    information = D.T @ np.linalg.solve(rows.unchanged, D)
    occam = np.linalg.slogdet(np.eye(6) + information * _prior(1e-3))[1]
    sigmas = np.sqrt(2 * np.log(3 * len(SCALES) * EVIDENCE) + occam) + 1.64  # with 95 %
    values, axes = np.linalg.eigh(information[:3, :3])
    return axes.T[::-1], (sigmas / np.sqrt(np.maximum(values, 1e-300)))[::-1]
