# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Points in two frames from a file: the sensor is beside the robot (Wu 2017)."""
from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.errors import DataError, TooFewError
from handeye_ros.estimation.least_squares import adjust, Rows, System
from handeye_ros.results.calibration_file import input_values
from handeye_ros.tables import Table
from handeye_ros.tabulated.method import Answer, FileMethod, Index, Input, ReadBag
import numpy as np
from numpy.typing import NDArray

NAME = 'the transform between two sets of points'
MINIMUM = 4
ALL_TRIPLES = 40  # up to this number of points, all triples are tried as a start
TRIPLES = 2000
JUDGES = 500  # largest number of points that judge the triples
BELIEVED_SHARE = 0.7
SMALLEST_ANGLE = 0.05  # smallest spread across over spread along (rad)
LARGEST_DROPPED_SHARE = 0.34
LARGEST_RMS = 5e-3  # of an answer that can be trusted (m)
CLEAR = 0.05  # of the spread of the points is left where the unit is right


@dataclass(frozen=True, eq=False)
class PointsResult:
    """
    The result.

    T_base_camera: (4, 4); covariance: (6, 6) of x y z rx ry rz in the base; used: indices of the
    used points; residuals: (n,) distances of all points (m); noise: 1 sigma per axis of a
    difference (m); rms, holdout_rms: of the used points (m), the latter with each predicted
    without itself.
    """

    T_base_camera: Array
    covariance: Array
    used: NDArray[np.intp]
    residuals: Array
    noise: float
    rms: float
    holdout_rms: float


def read(path: Path) -> tuple[Array, Array]:
    """
    Return the points (n, 3) in camera and base (metres) of a file.

    Columns camera_x, camera_y, camera_z, base_x, base_y, base_z, each with its unit as in
    `base_x [mm]`; see tables. Raises TableError.
    """
    table = Table(path)
    return table.points('camera'), table.points('base')


def solve(in_camera: Array, in_base: Array, noise: float | None = None,
          rng: np.random.Generator | None = None) -> PointsResult:
    """
    Return the transform from the same points (n, 3) in both frames (metres).

    noise: 1 sigma per axis of the difference of a pair (m), estimated when not given; rng: for
    random triples of more than ALL_TRIPLES points. Raises TooFewError, DataError.
    """
    if len(in_base) < MINIMUM:
        raise TooFewError(NAME, MINIMUM, 'points', len(in_base))
    rng = rng or np.random.default_rng(0)
    start = _start(in_camera, in_base, rng)
    off = np.linalg.norm(se3.apply(start, in_camera) - in_base, axis=1)
    sigma = noise or max(float(np.median(off)), 1e-9)
    fit = adjust(_system(in_camera, in_base, sigma), start, MINIMUM)
    if noise is None:
        sigma = max(sigma * fit.variance_factor ** 0.5, 1e-9)
        fit = adjust(_system(in_camera, in_base, sigma), fit.state, MINIMUM)
    rms = _rms(fit.residuals[fit.used] * sigma)
    _require_triangle(in_base[fit.used])
    dropped, total = len(in_base) - len(fit.used), len(in_base)
    if rms > LARGEST_RMS or dropped > LARGEST_DROPPED_SHARE * total:
        raise DataError(
            f'{NAME} cannot be solved: {dropped} of {total} points contradict the others, which '
            f'agree to {rms * 1e3:.3g} mm RMS; {_unit_that_fits(in_camera, in_base, rng)}',
            reason='misfit')
    return PointsResult(fit.state, fit.covariance, fit.used,
                        np.linalg.norm(fit.residuals, axis=1) * sigma, sigma, rms,
                        _rms(fit.left_out * sigma))


def _rms(vectors: Array) -> float:
    return float(np.sqrt((vectors ** 2).sum(axis=1).mean()))


def _system(in_camera: Array, in_base: Array, sigma: float) -> System[Array]:
    """Return the least-squares system; each point is a block."""
    def rows(T: Array) -> Rows:
        turned = in_camera @ T[:3, :3].T

        def jacobian() -> Array:
            by_shift = np.tile(np.eye(3), (len(turned), 1, 1))
            return np.concatenate([by_shift, -se3.skew(turned)], axis=2).reshape(-1, 6) / sigma
        return Rows((turned + T[:3, 3] - in_base).ravel() / sigma, jacobian)
    return System(rows, se3.perturb, np.repeat(np.arange(len(in_base)), 3))


def fit_rigid(a: Array, b: Array) -> Array:
    """Return T (..., 4, 4) that minimises |b - T a|^2 over points (..., n, 3) (Kabsch)."""
    mean_a, mean_b = a.mean(axis=-2), b.mean(axis=-2)
    M = np.swapaxes(b - mean_b[..., None, :], -1, -2) @ (a - mean_a[..., None, :])
    U, _, Vt = np.linalg.svd(M)
    U[..., :, 2] *= np.linalg.det(U @ Vt)[..., None]
    R = U @ Vt
    return se3.transform(R, mean_b - (R @ mean_a[..., None])[..., 0])


def _start(in_camera: Array, in_base: Array, rng: np.random.Generator) -> Array:
    """Return the three-point transform with the smallest BELIEVED_SHARE residual quantile."""
    n = len(in_base)
    if n <= ALL_TRIPLES:
        triples = np.array(list(combinations(range(n), 3)))
    else:
        triples = np.array([rng.choice(n, 3, replace=False) for _ in range(TRIPLES)])
    if len(triples) > TRIPLES:
        triples = triples[rng.permutation(len(triples))[:TRIPLES]]
    T = fit_rigid(in_camera[triples], in_base[triples])
    some = rng.permutation(n)[:JUDGES]
    off = np.linalg.norm(se3.apply(T, in_camera[some]) - in_base[some], axis=-1)
    return np.asarray(T[int(np.argmin(np.quantile(off, BELIEVED_SHARE, axis=1)))])


def _require_triangle(points: Array) -> None:
    """Raise for points (n, 3) that are (nearly) collinear."""
    along, across = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[:2]
    if across < SMALLEST_ANGLE * along:
        raise DataError(
            f'{NAME} cannot be solved: the points lie in one line, so a turn about it is free; '
            'put some of them well outside it')


def _unit_that_fits(in_camera: Array, in_base: Array, rng: np.random.Generator) -> str:
    """Return in words what to correct: the unit, if another one of a list makes points agree."""
    spread = float(np.linalg.norm(in_base - in_base.mean(axis=0), axis=1).mean())
    for factor, other in ((1e-3, 'smaller'), (1e3, 'larger')):
        T = _start(in_camera * factor, in_base, rng)
        off = np.linalg.norm(se3.apply(T, in_camera * factor) - in_base, axis=1)
        if np.quantile(off, BELIEVED_SHARE) < CLEAR * spread:
            return (f'with those of the camera 1000 times {other} they fit: correct the unit in '
                    'the header of camera_x, camera_y, camera_z, or of base_x, base_y, base_z')
    return 'check that both lists hold the same points in the same order, and their units'


@dataclass(frozen=True, eq=False)
class Pairs:
    """The same points (n, 3) in the frame of the sensor and in the robot's base; metres."""

    in_camera: Array
    in_base: Array


def _read(path: Path, config: Config, read_bag: ReadBag) -> Input[Pairs]:
    return Input(Pairs(*read(path)), config.sensor_frame, (input_values(path),))


def _solve(data: Pairs, config: Config) -> Answer[Pairs]:
    found = solve(data.in_camera, data.in_base)
    used = np.isin(np.arange(len(data.in_base)), found.used)
    return Answer(found.T_base_camera, found.covariance, used, found.residuals, found.rms,
                  found.holdout_rms, _subset(data, found.used), {'point_noise': found.noise})


def _samples(data: Pairs) -> list[tuple[int, str]]:
    return [(row, '') for row in range(1, len(data.in_base) + 1)]


def _subset(data: Pairs, keep: Index) -> Pairs:
    return Pairs(data.in_camera[keep], data.in_base[keep])


def _residuals(data: Pairs, X: Array, fitted: Index, measured: Index, config: Config) -> Array:
    off = se3.apply(X, data.in_camera[measured]) - data.in_base[measured]
    return np.asarray(np.linalg.norm(off, axis=1))


POINTS = FileMethod(
    'points', ('eye_on_base',), 'take more points, spread over a larger volume',
    _read, _solve, _samples, _subset, _residuals, lambda data: data.in_camera,
    'the points of the file')
