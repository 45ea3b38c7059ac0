# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Pose and velocity of the flange as a function of time, with their uncertainty.

Reported poses have errors, are rounded, and their stamps jitter. Uniform cubic B-splines are
fitted to the translation and to the four numbers of the quaternion, which is normalised afterwards
(between two poses that differ by an angle a the error is of order a^4). Least squares with knots
as far apart as the poses allow averages white errors. Generalised cross-validation determines the
spacing of the knots (Craven and Wahba 1979, Numer. Math. 31:377).
"""
from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

from handeye_ros import se3
from handeye_ros.data import Array, robust_std, TimedPose
from handeye_ros.sampling.stream import in_majority_order
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import csr_array, diags

# spacings of knots that are tried (s)
KNOT_SPACINGS = (0.4, 0.28, 0.2, 0.14, 0.1, 0.07, 0.05, 0.035, 0.025, 0.018, 0.012)
FEWEST_POSES = 8  # fewest poses of a piece
AT_ONCE = 500  # stamps of which the uncertainty is evaluated together
# the four functions at a time, by the powers of its share of the interval between two knots
CUBIC = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6
STIFFNESS = 1e-8  # of the spline, where there are no poses
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
        value, rate = np.zeros((2, 2 * n, 7))
        value[:, 6], inside = 1.0, np.zeros(2 * n, dtype=bool)
        for piece, chosen in self._by_piece(both):
            some = both[chosen]
            inside[chosen] = (some >= piece.first) & (some <= piece.last)
            value[chosen], rate[chosen] = piece.at(some)
        length = np.linalg.norm(value[n:, 3:], axis=1, keepdims=True)
        q, dq = value[n:, 3:] / length, rate[n:, 3:] / length
        # the vector of 2 dq/dt q*, in which the change of length is of the scalar part alone
        turning = 2 * (q[:, 3:] * dq[:, :3] - dq[:, 3:] * q[:, :3]
                       - np.cross(dq[:, :3], q[:, :3]))
        return Instants(se3.from_quaternion(value[:n, :3], q), np.hstack([rate[:n, :3], turning]),
                        inside[:n] & inside[n:])

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
    A spline of translation and quaternion from first to last, with knots at equal intervals.

    interval: seconds; coefficients: (intervals + 3, 7); std: (2,) 1 sigma of single poses (m,
    rad); root: the banded Cholesky factor of the information about coefficients by poses of unit
    variance.
    """

    first: int
    last: int
    interval: float
    coefficients: Array
    std: Array
    root: Array

    def _rows(self, stamps: NDArray[np.int64], rates: bool = False) -> Any:
        t = np.asarray((np.clip(stamps, self.first, self.last) - self.first) * 1e-9)
        return _spline_rows(t, self.interval, len(self.coefficients), rates)

    def at(self, stamps: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return translation and quaternion (n, 7), and rates; outside those of the next end."""
        return self._rows(stamps) @ self.coefficients, self._rows(stamps, True) @ self.coefficients

    def std_at(self, stamps: NDArray[np.int64]) -> Array:
        """Return 1 sigma of positions and rotations, (n, 2)."""
        rows = self._rows(stamps)
        parts = (rows[k:k + AT_ONCE] for k in range(0, len(stamps), AT_ONCE))
        leverage = [part.multiply(cho_solve_banded((self.root, True), part.T.toarray()).T).sum(
            axis=1) for part in parts]
        return np.asarray(np.sqrt(np.concatenate(leverage).reshape(-1, 1)) * self.std)


def _spline_rows(t: Array, interval: float, count: int, rates: bool = False) -> Any:
    """
    Return what makes values, or their rates, at times t (n,) of coefficients: sparse (n, count).

    interval: between knots (s), from 0; the last one may be longer or shorter by half.
    """
    first = np.minimum((t / interval).astype(np.int64), count - 4)
    powers = np.vander(t / interval - first, 4, increasing=True)
    if rates:
        powers = np.insert(powers[:, :3] * [1, 2, 3], 0, 0.0, axis=1) / interval
    columns, ends = first[:, None] + np.arange(4), np.arange(0, 4 * len(t) + 1, 4)
    return csr_array(((powers @ CUBIC).ravel(), columns.ravel(), ends), (len(t), count))


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
    rows = rows[in_majority_order(rows['stamp'], 'of the poses')]
    stamps, first_of = np.unique(rows['stamp'], return_index=True)
    return Trajectory(stamps, rows['pose'][first_of], max_gap)


def _piece_through(stamps: NDArray[np.int64], values: Array) -> _Piece:
    """
    Return the piece through poses (n, 7) with the knots that predict them best.

    A few poses far from the spline through all are not used; of many, it is the spline that is
    wrong.
    """
    t, values = (stamps - stamps[0]) * 1e-9, _with_steady_signs(values)
    spline, off = _smoothed(t, values)
    near = _near_most(off)
    if not near.all() and near.mean() > 0.95:
        spline, _ = _smoothed(t[near], values[near])
    return _Piece(int(stamps[0]), int(stamps[-1]), *spline)


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


def _smoothed(t: Array, values: Array) -> tuple[tuple[float, Array, Array, Array], Array]:
    """
    Return interval, coefficients, std and root of the best piece, and its residuals (n, 7).

    The knots have the least generalised cross-validation error, log(squares / freedom^2), of
    positions and rotations together.
    """
    least, best = np.inf, None
    widest = max(KNOT_SPACINGS[0], 2 * t[-1] / (len(t) - 1))  # two poses to each interval
    for interval in (widest, *KNOT_SPACINGS[1:]):
        count = max(int(t[-1] / interval + 0.5), 1) + 3
        freedom = len(t) - count
        if best and freedom < len(t) / 3:
            break
        rows = _spline_rows(t, interval, count)
        bends = csr_array(diags([1.0, -2.0, 1.0], [0, 1, 2], (count - 2, count)))
        information = rows.T @ rows + STIFFNESS * bends.T @ bends
        root = cholesky_banded([np.append(information.diagonal(k), np.zeros(k))
                                for k in range(4)], lower=True)
        coefficients = cho_solve_banded((root, True), rows.T @ values)
        off = values - rows @ coefficients
        # of each axis; a quaternion has half of the angle about three axes
        squares = off ** 2
        sums = np.array([squares[:, :3].sum() / 3, squares[:, 3:].sum() * 4 / 3]) + 1e-30
        error = float(np.log(sums / max(freedom, 1) ** 2).sum())
        if error < least + 2 * np.log(0.995):  # nearer knots must be worth 0.5 %
            least = error
            best = (interval, coefficients, np.sqrt(sums / max(freedom, 1)), root), off
    assert best is not None
    return best
