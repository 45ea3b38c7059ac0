# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Pose and velocity of the flange as a function of time, with their uncertainty.

Reported poses have errors, are rounded, and their stamps jitter. Cubic splines are fitted to the
translation and to the four numbers of the quaternion, which is normalised afterwards (between two
poses that differ by an angle a the error is of order a^4). Least squares with knots as far apart
as the poses allow averages white errors. Generalised cross-validation determines the spacing of
the knots (Craven and Wahba 1979, Numer. Math. 31:377).
"""
from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

from handeye_ros import se3
from handeye_ros.data import Array, robust_std, TimedPose
from handeye_ros.sampling.stream import fitting
import numpy as np
from numpy.typing import NDArray

SPLINE_DEGREE = 3
# spacings of knots that are tried (s)
KNOT_SPACINGS = (0.4, 0.28, 0.2, 0.14, 0.1, 0.07, 0.05, 0.035, 0.025, 0.018, 0.012)
FEWEST_POSES = 8  # fewest poses of a piece
AT_ONCE = 500  # stamps of which the uncertainty is evaluated together
AVERAGING_TIME = 0.004  # time over which many poses are averaged (s)
OUTLIER_SCATTERS = 8.0  # residual, in robust scatters, above which a pose is an outlier


@dataclass(frozen=True, eq=False)
class Instants:
    """
    The flange at n times: poses (n, 4, 4), twists (n, 6).

    twist: velocity of its origin (m/s) and angular velocity (rad/s), base frame. inside: (n,)
    whether there are poses around the time; elsewhere the values of the nearest end are used.
    """

    T_base_flange: Array
    twists: Array
    inside: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """
    Poses of the flange in the order of their stamps, as a function of time.

    stamps: (n,) integer nanoseconds
    values: (n, 7) translation and quaternion x y z w
    max_gap: poses further apart (s) are not interpolated
    """

    stamps: NDArray[np.int64]
    values: Array
    max_gap: float

    @cached_property
    def longest_bridged(self) -> float:
        """Return the longest time (s) between two poses that is interpolated."""
        period = float(np.median(np.diff(self.stamps))) * 1e-9 if len(self.stamps) > 1 else 0.0
        return min(self.max_gap, max(4.0 * period, 0.06))

    @cached_property
    def pieces(self) -> tuple[_Piece, ...]:
        """Return the pieces between the gaps."""
        ends = np.flatnonzero(np.diff(self.stamps) > self.longest_bridged * 1e9) + 1
        parts = zip(np.split(self.stamps, ends), np.split(self.values, ends), strict=True)
        return tuple(_piece_through(stamps, values) for stamps, values in parts
                     if len(stamps) >= FEWEST_POSES)

    def at(self, stamps: NDArray[np.int64], lag: float = 0.0) -> Instants:
        """Return the flange at stamps (n,); lag: of the reported rotation (s)."""
        n, both = len(stamps), np.concatenate([stamps, stamps + round(lag * 1e9)])
        T, twists = np.tile(np.eye(4), (2 * n, 1, 1)), np.zeros((2 * n, 6))
        inside = np.zeros(2 * n, dtype=bool)
        for piece, chosen in self._by_piece(both):
            some = both[chosen]
            inside[chosen] = (some >= piece.first) & (some <= piece.last)
            T[chosen], twists[chosen] = piece.at(some)
        T[:n, :3, :3], twists[:n, 3:] = T[n:, :3, :3], twists[n:, 3:]
        return Instants(T[:n], twists[:n], inside[:n] & inside[n:])

    def std(self, stamps: NDArray[np.int64]) -> Array:
        """Return 1 sigma of the poses at stamps (n,), each axis: (n, 2) in m and rad."""
        std = np.full((len(stamps), 2), np.inf)
        for piece, chosen in self._by_piece(stamps):
            std[chosen] = piece.std_at(stamps[chosen])
        return std

    def _by_piece(self, stamps: NDArray[np.int64]
                  ) -> Iterator[tuple[_Piece, NDArray[np.bool_]]]:
        # of a stamp in a gap the piece with the nearest end
        middles = np.array([before.last + (after.first - before.last) // 2
                            for before, after in pairwise(self.pieces)], dtype=np.int64)
        which = np.searchsorted(middles, stamps)
        for k, piece in enumerate(self.pieces):
            if (chosen := which == k).any():
                yield piece, chosen


@dataclass(frozen=True, eq=False)
class _Piece:
    """
    A spline of translation and quaternion over seconds since first.

    std: (2,) 1 sigma of single poses (m, rad); information: (k, k) of the spline coefficients, for
    poses of unit variance, sparse.
    """

    first: int
    last: int
    spline: Any
    std: Array
    information: Any

    def _time(self, stamps: NDArray[np.int64]) -> Array:
        return np.asarray((np.clip(stamps, self.first, self.last) - self.first) * 1e-9)

    def at(self, stamps: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return poses (n, 4, 4) and twists (n, 6); outside the piece those of its nearest end."""
        t = self._time(stamps)
        value, rate = self.spline(t), self.spline(t, 1)
        length = np.linalg.norm(value[:, 3:], axis=1, keepdims=True)
        q, dq = value[:, 3:] / length, rate[:, 3:] / length
        # the vector of 2 dq/dt q*, in which the change of length is of the scalar part alone
        turning = 2 * (q[:, 3:] * dq[:, :3] - dq[:, 3:] * q[:, :3]
                       - np.cross(dq[:, :3], q[:, :3]))
        return (se3.from_quaternion(value[:, :3], q),
                np.concatenate([rate[:, :3], turning], axis=1))

    def std_at(self, stamps: NDArray[np.int64]) -> Array:
        """Return 1 sigma of positions and rotations, (n, 2)."""
        from scipy.interpolate import BSpline  # 0.09 s, only for sweeps
        from scipy.sparse.linalg import splu
        rows = BSpline.design_matrix(self._time(stamps), self.spline.t, SPLINE_DEGREE)
        solve = splu(self.information).solve
        parts = (rows[k:k + AT_ONCE] for k in range(0, len(stamps), AT_ONCE))
        leverage = [part.multiply(solve(part.T.toarray()).T).sum(axis=1) for part in parts]
        return np.asarray(np.sqrt(np.concatenate(leverage).reshape(-1, 1)) * self.std)


def joined(parts: Sequence[Trajectory]) -> Trajectory:
    """Return one trajectory from parts of one stream, in any order."""
    stamps, first = np.unique(np.concatenate([part.stamps for part in parts]), return_index=True)
    values = np.concatenate([part.values for part in parts])[first]
    return Trajectory(stamps, values, max(part.max_gap for part in parts))


def trajectory_of(poses: Iterable[TimedPose], max_gap: float) -> Trajectory:
    """
    Return the trajectory of poses in any order, without those with implausible stamps.

    Raises DataError when two runs are mixed.
    """
    rows = np.fromiter(((p.stamp, (*p.translation, *p.quaternion)) for p in poses),
                       np.dtype([('stamp', np.int64), ('pose', np.float64, 7)]))
    rows = rows[fitting(rows['stamp'], 'of the poses')]
    stamps, first_of = np.unique(rows['stamp'], return_index=True)
    return Trajectory(stamps, rows['pose'][first_of], max_gap)


def _averaged(t: Array, values: Array) -> tuple[Array, Array]:
    """
    Return means of consecutive poses over a time of nearly constant speed.

    The first and last pose are kept, so that the trajectory covers the same time.
    """
    count = int(AVERAGING_TIME * (len(t) - 1) / max(t[-1], AVERAGING_TIME))
    if count < 2:
        return t, values
    begins = np.array([0, *range(1, len(t) - 1, count), len(t) - 1])
    number = np.diff([*begins, len(t)])
    t, values = (np.add.reduceat(v, begins) / number.reshape(-1, *[1] * (v.ndim - 1))
                 for v in (t, values))
    return t, values


def _piece_through(stamps: NDArray[np.int64], values: Array) -> _Piece:
    """
    Return the piece through poses (n, 7) with the knots that predict them best.

    A few poses far from the spline through all are not used; of many, it is the spline that is
    wrong.
    """
    t, values = _averaged((stamps - stamps[0]) * 1e-9, _with_steady_signs(values))
    spline, pose_std, information = _smoothed(t, values)
    near = _near_most(values - spline(t))
    if not near.all() and near.mean() > 0.95:
        spline, pose_std, information = _smoothed(t[near], values[near])
    return _Piece(int(stamps[0]), int(stamps[-1]), spline, pose_std, information)


def _with_steady_signs(values: Array) -> Array:
    """Return poses (n, 7) whose quaternions do not jump: q and -q are one rotation."""
    turned = (values[1:, 3:] * values[:-1, 3:]).sum(axis=1) < 0
    signs = np.where(np.cumsum(turned) % 2, -1.0, 1.0)[:, None]
    return np.hstack([values[:, :3], np.vstack([values[:1, 3:], values[1:, 3:] * signs])])


def _near_most(off: Array) -> NDArray[np.bool_]:
    """Return which poses are off (n, 7) a spline as most are, or less than 1 mm and 5 mrad."""
    size = np.abs(off) / np.repeat([1e-3, 5e-3 / 2], [3, 4])
    usual = np.array([robust_std(axis) for axis in size.T])
    near = (size <= np.maximum(OUTLIER_SCATTERS * usual, 1.0)).all(axis=1)
    near[[0, -1]] = True
    return np.asarray(near)


def _smoothed(t: Array, values: Array) -> tuple[Any, Array, Any]:
    """
    Return the spline with the best knots, the std (2,) of single poses, and its information.

    The knots have the least generalised cross-validation error, log(squares / freedom^2), of
    positions and rotations together.
    """
    from scipy.interpolate import BSpline
    from scipy.sparse.linalg import splu
    least, best = np.inf, None
    for spacing in KNOT_SPACINGS:
        knots = _knots(t, spacing)
        freedom = len(t) - (len(knots) - SPLINE_DEGREE - 1)
        if best and freedom < len(t) / 3:
            break
        rows = BSpline.design_matrix(t, knots, SPLINE_DEGREE)
        information = (rows.T @ rows).tocsc()
        spline = BSpline(knots, splu(information).solve(rows.T @ values), SPLINE_DEGREE)
        squares = (values - rows @ spline.c) ** 2
        # of each axis; a quaternion has half of the angle about three axes
        sums = np.array([squares[:, :3].sum() / 3, squares[:, 3:].sum() * 4 / 3]) + 1e-30
        error = float(np.log(sums / max(freedom, 1) ** 2).sum())
        if error < least + 2 * np.log(0.98):  # nearer knots must be worth 2 %
            least, best = error, (spline, np.sqrt(sums / max(freedom, 1)), information)
    assert best is not None
    return best


def _knots(t: Array, spacing: float) -> Array:
    """Return knots at times of poses, at least a spacing apart, with two poses between them."""
    inner, last = [], 0
    candidates = np.searchsorted(t, np.arange(t[0] + spacing, t[-1] - 0.5 * spacing, spacing))
    for k in candidates.tolist():
        if k - last >= 2 and len(t) - 1 - k >= 2:
            inner.append(float(t[k]))
            last = k
    return np.concatenate([[t[0]] * (SPLINE_DEGREE + 1), inner, [t[-1]] * (SPLINE_DEGREE + 1)])
