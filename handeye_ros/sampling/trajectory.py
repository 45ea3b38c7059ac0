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
from handeye_ros.arithmetic import robust_std
from handeye_ros.data import Array, TimedPose
from handeye_ros.sampling.stream import in_majority_order
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import csr_array, diags

# spacings of knots that are tried (s)
KNOT_SPACINGS = (0.4, 0.28, 0.2, 0.14, 0.1, 0.07, 0.05, 0.035, 0.025, 0.018, 0.012)
MIN_POSES = 8  # fewest poses of a piece
AT_ONCE = 500  # stamps of which the uncertainty is evaluated together
STIFFNESS = 1e-8  # of the spline, where there are no poses
OUTLIER_SCATTERS = 8.0  # residual, in robust scatters, above which a pose is an outlier


@dataclass(frozen=True, eq=False)
class FlangeStates:
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
        """Return the longest time (s) between two poses that is interpolated: some may be lost."""
        period = float(np.median(np.diff(self.stamps))) * 1e-9 if len(self.stamps) > 1 else 0.0
        return min(self.max_gap, max(4.0 * period, 0.06))

    @cached_property
    def pieces(self) -> tuple[_SplinePiece, ...]:
        """Return the pieces between the gaps."""
        ends = np.flatnonzero(np.diff(self.stamps) > self.longest_bridged * 1e9) + 1
        parts = zip(np.split(self.stamps, ends), np.split(self.values, ends), strict=True)
        return tuple(_piece_through(stamps, values) for stamps, values in parts
                     if len(stamps) >= MIN_POSES)

    def at(self, stamps: NDArray[np.int64], lag: float = 0.0) -> FlangeStates:
        """
        Return the flange at stamps (n,); lag: of the reported rotation (s).

        Without any piece it is the identity at rest, and never inside.
        """
        values, rates, inside = self._at(stamps)
        later_values, later_rates, later_inside = self._at(stamps + round(lag * 1e9))
        length = np.linalg.norm(later_values[:, 3:], axis=1, keepdims=True)
        q, dq = later_values[:, 3:] / length, later_rates[:, 3:] / length
        # the vector of 2 dq/dt q*, in which the change of length is of the scalar part alone
        turning = 2 * (q[:, 3:] * dq[:, :3] - dq[:, 3:] * q[:, :3] - np.cross(dq[:, :3], q[:, :3]))
        return FlangeStates(se3.from_quaternion(values[:, :3], q),
                            np.hstack([rates[:, :3], turning]), inside & later_inside)

    def _at(self, stamps: NDArray[np.int64]) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return translation and quaternion (n, 7), their rates, and which are inside (n,)."""
        values, rates = np.zeros((2, len(stamps), 7))
        values[:, 6], inside = 1.0, np.zeros(len(stamps), dtype=bool)
        for piece, nearest in self._nearest_pieces(stamps):
            values[nearest], rates[nearest] = piece.at(stamps[nearest])
            inside[nearest] = (stamps[nearest] >= piece.first) & (stamps[nearest] <= piece.last)
        return values, rates, inside

    def std(self, stamps: NDArray[np.int64]) -> Array:
        """Return 1 sigma of the poses at stamps (n,), each axis: (n, 2) in m and rad, or inf."""
        std = np.full((len(stamps), 2), np.inf)
        for piece, nearest in self._nearest_pieces(stamps):
            std[nearest] = piece.std_at(stamps[nearest])
        return std

    def _nearest_pieces(self, stamps: NDArray[np.int64]
                        ) -> Iterator[tuple[_SplinePiece, NDArray[np.bool_]]]:
        """Yield each piece with the stamps (n,) to which it is the nearest one, if any."""
        middles = np.array([before.last + (after.first - before.last) // 2
                            for before, after in pairwise(self.pieces)], dtype=np.int64)
        index = np.searchsorted(middles, stamps)
        for k, piece in enumerate(self.pieces):
            if (nearest := index == k).any():
                yield piece, nearest


@dataclass(frozen=True, eq=False)
class _SplinePiece:
    """
    A cubic spline of translation and quaternion, from one stamp to another.

    spline: scipy's BSpline of (n, 7) over the seconds since the first stamp
    std: (2,) 1 sigma of single poses (m, rad)
    root: the banded Cholesky factor of the information about the coefficients by poses of unit
        variance
    """

    first: int
    last: int
    spline: Any
    std: Array
    root: Array

    def _seconds(self, stamps: NDArray[np.int64]) -> Array:
        """Return the times (n,) of stamps in the spline; outside, that of the next end."""
        return np.asarray((np.clip(stamps, self.first, self.last) - self.first) * 1e-9)

    def at(self, stamps: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return translation and quaternion (n, 7), and rates; outside those of the next end."""
        t = self._seconds(stamps)
        return self.spline(t), self.spline(t, 1)

    def std_at(self, stamps: NDArray[np.int64]) -> Array:
        """Return 1 sigma of positions and rotations, (n, 2)."""
        design = self.spline.design_matrix(self._seconds(stamps), self.spline.t, 3, True)
        parts = (design[k:k + AT_ONCE] for k in range(0, len(stamps), AT_ONCE))
        leverage = [part.multiply(cho_solve_banded((self.root, True), part.T.toarray()).T).sum(
            axis=1) for part in parts]
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
    rows = rows[in_majority_order(rows['stamp'], 'of the poses')]
    stamps, first_of = np.unique(rows['stamp'], return_index=True)
    return Trajectory(stamps, rows['pose'][first_of], max_gap)


def _piece_through(stamps: NDArray[np.int64], values: Array) -> _SplinePiece:
    """
    Return the piece through poses (n, 7) with the knots that predict them best.

    A few poses far from the spline through all are not used; of many, it is the spline that is
    wrong.
    """
    values = _with_steady_signs(values)
    piece, residuals = _fitted_spline(stamps, values)
    fits = _are_inliers(residuals)
    if not fits.all() and fits.mean() > 0.95:
        piece, _ = _fitted_spline(stamps[fits], values[fits])
    return piece


def _with_steady_signs(values: Array) -> Array:
    """Return poses (n, 7) whose quaternions do not jump: q and -q are one rotation."""
    turned = (values[1:, 3:] * values[:-1, 3:]).sum(axis=1) < 0
    signs = np.where(np.cumsum(turned) % 2, -1.0, 1.0)[:, None]
    return np.hstack([values[:, :3], np.vstack([values[:1, 3:], values[1:, 3:] * signs])])


def _are_inliers(residuals: Array) -> NDArray[np.bool_]:
    """
    Return which poses are as far from a spline as most are, or less than 1 mm and 5 mrad.

    residuals: (n, 7) of the poses. The first and the last one always are.
    """
    size = np.abs(residuals) / np.repeat([1e-3, 5e-3 / 2], [3, 4])
    usual = np.array([robust_std(axis) for axis in size.T])
    fits = (size <= np.maximum(OUTLIER_SCATTERS * usual, 1.0)).all(axis=1)
    fits[[0, -1]] = True
    return np.asarray(fits)


def _fitted_spline(stamps: NDArray[np.int64], values: Array) -> tuple[_SplinePiece, Array]:
    """
    Return the least-squares spline through poses (n, 7), and its residuals (n, 7).

    Its knots are at equal intervals, the last one longer or shorter by half at most, and have the
    least generalised cross-validation error, log(squares / freedom^2), of positions and rotations
    together.
    """
    from scipy.interpolate import BSpline  # 0.09 s, only for robots that move
    t = (stamps - stamps[0]) * 1e-9
    least, best = np.inf, None
    widest = max(KNOT_SPACINGS[0], 2 * t[-1] / (len(t) - 1))  # two poses to each interval
    for interval in (widest, *KNOT_SPACINGS[1:]):
        count = max(int(t[-1] / interval + 0.5), 1) + 3
        freedom = len(t) - count
        if best and freedom < len(t) / 3:  # of so few the error says little
            break
        knots = interval * np.arange(-3.0, count + 1)
        design = BSpline.design_matrix(t, knots, 3, True)
        bends = csr_array(diags([1.0, -2.0, 1.0], [0, 1, 2], (count - 2, count)))
        information = design.T @ design + STIFFNESS * bends.T @ bends
        root = cholesky_banded([np.append(information.diagonal(k), np.zeros(k))
                                for k in range(4)], lower=True)
        coefficients = cho_solve_banded((root, True), design.T @ values)
        residuals = values - design @ coefficients
        # of each axis; a quaternion has half of the angle about three axes
        squares = residuals ** 2
        sums = np.array([squares[:, :3].sum() / 3, squares[:, 3:].sum() * 4 / 3]) + 1e-30
        error = float(np.log(sums / max(freedom, 1) ** 2).sum())
        if error < least + 2 * np.log(0.995):  # nearer knots must be worth 0.5 %
            least = error
            best = _SplinePiece(int(stamps[0]), int(stamps[-1]), BSpline(knots, coefficients, 3),
                                np.sqrt(sums / max(freedom, 1)), root), residuals
    assert best is not None
    return best
