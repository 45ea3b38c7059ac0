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

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
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
KNOTS_OF_GAP = 4  # so far apart are the ends of a gap, that they do not bend each other
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
    def _is_gap(self) -> NDArray[np.bool_]:
        """Return after which poses (n,) nothing is interpolated; after the last there is none."""
        steps = np.diff(self.stamps) * 1e-9
        usual = float(np.median(steps)) if len(steps) else 0.0
        return np.append(steps > min(self.max_gap, max(4.0 * usual, 0.06)), True)

    @cached_property
    def _spline(self) -> _Spline:
        """
        Return the spline through the poses with the knots that predict them best.

        A few poses far from the spline through all are not used; of many, it is the spline that is
        wrong.
        """
        values, every = _with_steady_signs(self.values), np.ones(len(self.stamps), dtype=bool)
        spline, residuals = _fitted_spline(self.stamps, values, self._is_gap, every)
        used = _are_inliers(residuals)
        if not used.all() and used.mean() > 0.95:
            spline, _ = _fitted_spline(self.stamps, values, self._is_gap, used)
        return spline

    def at(self, stamps: NDArray[np.int64], lag: float = 0.0) -> FlangeStates:
        """Return the flange at stamps (n,); lag: of the reported rotation (s)."""
        curve = self._spline.curve
        t, inside = self._times(stamps)
        later_t, later_inside = self._times(stamps + round(lag * 1e9))
        q, dq = curve(later_t)[:, 3:], curve(later_t, 1)[:, 3:]
        length = np.linalg.norm(q, axis=1, keepdims=True)
        q, dq = q / length, dq / length
        # the vector of 2 dq/dt q*, in which the change of length is of the scalar part alone
        turning = 2 * (q[:, 3:] * dq[:, :3] - dq[:, 3:] * q[:, :3] - np.cross(dq[:, :3], q[:, :3]))
        return FlangeStates(se3.from_quaternion(curve(t)[:, :3], q),
                            np.hstack([curve(t, 1)[:, :3], turning]), inside & later_inside)

    def std(self, stamps: NDArray[np.int64]) -> Array:
        """Return 1 sigma of the poses at stamps (n,), each axis: (n, 2) in m and rad."""
        curve = self._spline.curve
        design = curve.design_matrix(self._times(stamps)[0], curve.t, 3, True)
        parts = (design[k:k + AT_ONCE] for k in range(0, len(stamps), AT_ONCE))
        leverage = [part.multiply(cho_solve_banded((self._spline.root, True), part.T.toarray()).T
                                  ).sum(axis=1) for part in parts]
        return np.asarray(
            np.sqrt(np.concatenate(leverage).reshape(-1, 1)) * self._spline.std)

    def _times(self, stamps: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        """Return the times of stamps (n,) in the spline, and which have poses around them (n,)."""
        after = self.stamps.searchsorted(stamps).clip(1, len(self.stamps) - 1)
        first, last = self.stamps[after - 1], self.stamps[after]
        nearest = np.where(stamps - first < last - stamps, first, last)
        between = (first < stamps) & (stamps < last) & ~self._is_gap[after - 1]
        held = np.where(between, stamps, nearest)
        start = self.stamps[0]  # the difference of stamps is exact
        return (np.interp(held - start, self.stamps - start, self._spline.times),
                between | (stamps == nearest))


@dataclass(frozen=True, eq=False)
class _Spline:
    """
    A cubic spline of translation and quaternion.

    times: (n,) of the poses in it (s); a gap counts as KNOTS_OF_GAP knots
    curve: scipy's BSpline of (n, 7) over these times
    std: (2,) 1 sigma of single poses (m, rad)
    root: the banded Cholesky factor of the information about the coefficients by poses of unit
        variance
    """

    times: Array
    curve: Any
    std: Array
    root: Array


def joined(parts: Sequence[Trajectory]) -> Trajectory:
    """Return one trajectory from parts of one stream, in any order."""
    stamps, first = np.unique(np.concatenate([part.stamps for part in parts]), return_index=True)
    values = np.concatenate([part.values for part in parts])[first]
    return Trajectory(stamps, values, max(part.max_gap for part in parts))


def trajectory_of(poses: Sequence[TimedPose], max_gap: float) -> Trajectory:
    """
    Return the trajectory of poses in any order, without those with implausible stamps.

    Raises DataError when two runs are mixed.
    """
    stamps = np.array([pose.stamp for pose in poses], dtype=np.int64)
    values = np.array([(*pose.translation, *pose.quaternion) for pose in poses]).reshape(-1, 7)
    fits = in_majority_order(stamps, 'of the poses')
    return joined([Trajectory(stamps[fits], values[fits], max_gap)])


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


def _fitted_spline(stamps: NDArray[np.int64], values: Array, is_gap: NDArray[np.bool_],
                   used: NDArray[np.bool_]) -> tuple[_Spline, Array]:
    """
    Return the least-squares spline through the used ones of poses (n, 7), and their residuals.

    Its knots are at equal intervals, the last one longer or shorter by half at most, and have the
    least generalised cross-validation error, log(squares / freedom^2), of positions and rotations
    together.
    """
    from scipy.interpolate import BSpline  # 0.09 s, only for robots that move
    steps, is_gap, values = np.diff(stamps) * 1e-9, is_gap[:-1], values[used]
    least, best = np.inf, None
    # two poses to each interval
    widest = max(KNOT_SPACINGS[0], 2 * float(steps[~is_gap].sum()) / max(len(steps), 1))
    for interval in (widest, *KNOT_SPACINGS[1:]):
        times = np.append(0.0, np.where(is_gap, KNOTS_OF_GAP * interval, steps).cumsum())
        count = max(int(times[-1] / interval + 0.5), 1) + 3
        freedom = len(values) - count
        if best and freedom < len(values) / 3:
            break
        knots = interval * np.arange(-3.0, count + 1)
        design = BSpline.design_matrix(times[used], knots, 3, True)
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
            best = _Spline(times, BSpline(knots, coefficients, 3),
                           np.sqrt(sums / max(freedom, 1)), root), residuals
    assert best is not None
    return best
