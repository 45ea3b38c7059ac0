"""
What changed since a calibration: nothing, the target, the sensor, or the robot.

Residuals r = g(p; target) of a recording at the answer of the calibration. With nothing changed,
r = G dX + J dη + e: dX and dη are the errors of the calibration's transform and target, with
their joint covariance (errors in common cancel), e the white noise of this recording. A moved
target adds T m, a moved sensor G m, m a twist; a changed robot adds an error of each pose, smooth
over the poses or white. Each has a normal prior whose scale is summed over SCALES, so each cause
has a marginal likelihood. Nothing is said to have changed unless the causes together are
EVIDENCE times as likely as none: by Markov's inequality a false alarm then has at most the chance
1 / EVIDENCE (Wald 1945).
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.estimation.model import Method, UNUSED
from handeye_ros.estimation.outliers import chi2_sf
from handeye_ros.frames import in_mount
from handeye_ros.targets.common import edges_of
from handeye_ros.verification.fixed_fit import (
    by_calibration,
    noise_factors,
    points_in_base,
    root_of,
    white,
)
from handeye_ros.verification.shapes import Seen
import numpy as np
from numpy.typing import NDArray

EVIDENCE = 100.0
SCALES = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)  # m: how far something moves, a priori
LEVER = 0.1  # m: a scale over it is that of a turn
SMOOTH_ANGLE, SMOOTH_DISTANCE = 1.5, 0.9  # rad, m: over which an error of the robot is alike
ITERATIONS = 6
SMOOTHNESS = (1.0, 2.0)  # times as far; bench/check.py: one joint's error reaches further
RANK = 1e-9
OUTLIER = 0.01  # chance that any good stop is left out
MOST_OUTLIERS = 0.15  # of the stops
CAUSES = ('target', 'sensor', 'robot')


@dataclass(frozen=True, eq=False)
class Comparison:
    """
    A recording beside the calibration it is compared with.

    X (4, 4), state (s,): sensor plane in the mount and target, as calibrated; covariance
    (6 + k, 6 + k): their joint one; noise_scale: by how much noise was larger then.
    """

    method: Method
    seen: Seen
    X: Array
    state: Array
    covariance: Array
    config: Config
    noise_scale: float = 1.0

    def labelled(self) -> Comparison:
        """Return it with the observations given to the parts of the target, the others left."""
        p = points_in_base(self.seen, self.X)
        obs = self.method.geometry.relabel(self.seen.observations, p, self.state, self.config)
        return replace(self, seen=replace(self.seen, observations=obs.select(obs.kind != UNUSED)))


@dataclass(frozen=True, eq=False)
class Rows:
    """
    Whitened residuals r (m,) and their derivatives; few rows of each station say all of them.

    known (m, c): what the calibration's errors make, in units of 1 sigma; target, sensor (m, 6):
    by a move of these; robot (m, 6): by the error of the pose, station (m,). constant: of the
    logarithm of the likelihood.
    """

    r: Array
    known: Array
    target: Array
    sensor: Array
    robot: Array
    station: NDArray[np.intp]
    constant: float

    @cached_property
    def unchanged(self) -> Array:
        """Return the covariance (m, m) where nothing changed."""
        return np.asarray(np.eye(len(self.r)) + self.known @ self.known.T)

    def likelihood(self, more: Array, r: Array | None = None) -> float:
        """Return the logarithm of the marginal likelihood; more: added covariance (m, m)."""
        factor = np.linalg.cholesky(self.unchanged + more)
        z = np.linalg.solve(factor, self.r if r is None else r)
        return float(-0.5 * z @ z - np.log(np.diag(factor)).sum() + self.constant)


@dataclass(frozen=True, eq=False)
class Cause:
    """
    One explanation: logarithm of its likelihood, the likeliest move (6,) and its covariance.

    displacement: of the points, at most (m), and its 1 sigma.
    """

    name: str
    likelihood: float
    move: Array
    covariance: Array
    displacement: float
    displacement_std: float


def rows_at(it: Comparison, cause: str, move: Array) -> Rows:
    """Return the residuals where the target or the sensor has moved so."""
    X = se3.perturb(it.X, move) if cause == 'sensor' else it.X
    seen, obs = it.seen, it.seen.observations
    p = points_in_base(seen, X)
    centre = points_in_base(it.seen, it.X).mean(axis=0)
    back = se3.transform(se3.exp_rotation(-move[3:]), np.zeros(3))[:3, :3]
    if cause == 'target':
        p = (p - centre - move[:3]) @ back.T + centre
    found = it.method.geometry.conditions(p, obs.kind, it.state, it.config)
    by_p = found.dg_dp @ back if cause == 'target' else found.dg_dp
    G = np.einsum('mi,mij->mj', by_p, by_calibration(seen, X))
    T = np.hstack([by_p, se3.cross(p - centre, by_p)])
    to_point = points_in_base(seen, X) - seen.poses[obs.station, :3, 3]
    E = np.hstack([by_p, se3.cross(to_point, by_p)])
    known = np.hstack([np.hstack([G, found.dg_dtarget]) @ root_of(it.covariance),
                       _setbacks(it, X, by_p)])
    # the error of the sensor's field differs from stop to stop, as that of the pose does
    blocks = noise_factors(seen, X, by_p, it.config.noise, it.config.noise.distortion)
    columns = white(blocks, np.hstack([found.g[:, None], known, T, -G, E])) / it.noise_scale
    constant = -sum(float(np.log(np.diag(factor)).sum()) for _, factor in blocks)
    parts, stations = [], []
    for station in np.unique(obs.station):
        own = columns[obs.station == station]
        U, s, _ = np.linalg.svd(own[:, 1:], full_matrices=False)
        parts.append(U[:, s > RANK * s[0]].T @ own)
        stations.append(np.full(len(parts[-1]), station))
        constant -= 0.5 * float(own[:, 0] @ own[:, 0] - parts[-1][:, 0] @ parts[-1][:, 0])
    r, known, *by = np.split(np.concatenate(parts), np.cumsum([1, known.shape[1], 6, 6]), axis=1)
    return Rows(r[:, 0], known, by[0], by[1], by[2], np.concatenate(stations), constant)


def _setbacks(it: Comparison, X: Array, by_p: Array) -> Array:
    """Return by how much (m, e) all ends of one kind at one edge may be set back, 1 sigma."""
    obs = edges_of(it.seen.observations)
    R = it.seen.poses[obs.station, :3, :3]
    out = np.einsum('mi,mij,jk,mk->m', by_p, R, X[:3, [0, 2]], obs.outward)
    groups = {(int(k), int(e)) for k, e in zip(obs.kind, obs.end, strict=True) if e}
    columns = [np.where((obs.kind == k) & (obs.end == e), out, 0.0) for k, e in sorted(groups)]
    return it.config.target.setback_std * np.reshape(columns, (-1, len(out))).T


def agreeing(it: Comparison) -> tuple[Comparison, list[int]]:
    """
    Return the comparison without stops that contradict the others, and which they are.

    By their leave-one-out residuals, with target and sensor free to have moved.
    """
    station, left_out = it.seen.observations.station, list[int]()
    most = int(MOST_OUTLIERS * len(np.unique(station)))
    some = it
    while len(left_out) < most:
        rows = rows_at(some, '', np.zeros(6))
        D, P = np.hstack([rows.target, rows.sensor]), np.tile(_prior(SCALES[-1]), 2)
        W = np.linalg.inv(rows.unchanged + (D * P) @ D.T)
        found, p = np.unique(rows.station), []
        for k in found:
            own = np.flatnonzero(rows.station == k)
            residual = W[own] @ rows.r
            p.append(float(chi2_sf(residual @ np.linalg.solve(W[np.ix_(own, own)], residual),
                                   len(own))))
        if min(p) * len(p) > OUTLIER:
            break
        left_out.append(int(found[int(np.argmin(p))]))
        keep = np.isin(station, left_out, invert=True)
        some = replace(it, seen=replace(it.seen, observations=it.seen.observations.select(keep)))
    return some, left_out


def causes(it: Comparison) -> tuple[float, tuple[Cause, ...]]:
    """Return the logarithm of the likelihood that nothing changed, and the causes."""
    still = rows_at(it, '', np.zeros(6))
    nothing = still.likelihood(np.zeros((len(still.r),) * 2))
    return nothing, (_moved(it, 'target'), _moved(it, 'sensor'), _robot(it, still))


def _prior(scale: float) -> Array:
    return np.repeat([scale, scale / LEVER], 3) ** 2


def _moved(it: Comparison, name: str) -> Cause:
    """Return the explanation by a moved target or sensor."""
    move, scale = np.zeros(6), SCALES[-1]
    for _ in range(ITERATIONS):
        rows = rows_at(it, name, move)
        D = getattr(rows, name)
        gain = D.T @ np.linalg.inv(rows.unchanged)
        C = np.linalg.inv(gain @ D + np.diag(1 / _prior(scale)))
        linear = rows.r + D @ move
        move = C @ gain @ linear
        likelihood = [rows.likelihood((D * _prior(s)) @ D.T, linear) for s in SCALES]
        scale = SCALES[int(np.argmax(likelihood))]
    by_move = _displacements(it, name)
    far = np.linalg.norm(by_move @ move, axis=1)
    worst = int(np.argmax(far))
    std = np.sqrt(np.trace(by_move[worst] @ C @ by_move[worst].T))
    return Cause(name, _mean(likelihood), move, C, float(far[worst]), float(std))


def _displacements(it: Comparison, name: str) -> Array:
    """Return the derivatives (m, 3, 6) of the points by a move."""
    if name == 'sensor':
        return by_calibration(it.seen, it.X)
    offset = points_in_base(it.seen, it.X) - points_in_base(it.seen, it.X).mean(axis=0)
    return np.concatenate([np.broadcast_to(np.eye(3), (len(offset), 3, 3)), -se3.skew(offset)],
                          axis=2)


def _robot(it: Comparison, rows: Rows) -> Cause:
    """Return the explanation by errors of the poses: smooth in base or flange, or white."""
    T = in_mount(it.seen.poses[rows.station], it.config)  # the flange in the base again
    away = np.linalg.norm(T[:, None, :3, 3] - T[None, :, :3, 3], axis=-1) / SMOOTH_DISTANCE
    cosine = (np.einsum('aij,bij->ab', T[:, :3, :3], T[:, :3, :3]) - 1) / 2
    square = away ** 2 + 2 * (1 - cosine) / SMOOTH_ANGLE ** 2  # of the chord: positive definite
    smooth, smoother = (np.exp(-0.5 * square / times ** 2) for times in SMOOTHNESS)
    kernels = ((rows.robot, smooth), (rows.robot, smoother), (rows.sensor, smoother),
               (rows.robot, rows.station[:, None] == rows.station))
    likelihood = [rows.likelihood((D * _prior(s)) @ D.T * kernel) for s in SCALES
                  for D, kernel in kernels]
    return Cause('robot', _mean(likelihood), np.zeros(6), np.zeros((6, 6)), 0.0, 0.0)


def _mean(logarithms: Sequence[float]) -> float:
    return float(np.logaddexp.reduce(logarithms) - np.log(len(logarithms)))


def smallest_moves(it: Comparison, name: str) -> tuple[Array, Array]:
    """
    Return along which axes (3, 3), as rows, and from which sizes on (3,) a shift would show.

    Of the target in the base, of the sensor in the flange; the smallest first, infinite where
    none would show.
    """
    rows = rows_at(it, '', np.zeros(6))
    D = getattr(rows, name)
    I6 = D.T @ np.linalg.solve(rows.unchanged, D)
    occam = np.linalg.slogdet(np.eye(6) + I6 * _prior(1e-3))[1]
    sigmas = np.sqrt(2 * np.log(3 * len(SCALES) * EVIDENCE) + occam) + 1.64  # with 95 %
    value, axes = np.linalg.eigh(I6[:3, :3])
    value = np.maximum(value, 1e-300)
    return axes.T[::-1], (sigmas / np.sqrt(value))[::-1]
