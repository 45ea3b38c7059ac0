# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Estimates from white residuals: with a prior, and without groups that contradict the others.

A verification fits a shape with them, a check predicts the recording from a calibration.
"""
from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Generic, NamedTuple, TypeVar

from handeye_ros import se3
from handeye_ros.data import Array, Indices
from handeye_ros.errors import DataError, InputError
from handeye_ros.estimation.least_squares import chi2_sf
from handeye_ros.estimation.outliers import drop_outliers
import numpy as np

ONE_SIDED_95 = 1.64  # sigmas that a normal value exceeds with 5 %
# a direction whose share left to the others is below this is determined by the group alone
LEFT_BY_OTHERS_SHARE = 1e-3
MAX_OUTLIER_SHARE = 0.2  # of the groups: more are no outliers, but a disagreement

Result = TypeVar('Result')


def regularised_least_squares(A: Array, b: Array, information: Array | float = 1.0
                              ) -> tuple[Array, Array, float]:
    """
    Return the x of least |b - A x|^2 + x' diag(information) x, its covariance, and this sum.

    A: (m, u), b: (m,), white; information: (u,) of the prior, whose mean is 0.
    """
    covariance = np.asarray(np.linalg.inv(A.T @ A + information * np.eye(A.shape[1])), float)
    explained = A.T @ b
    x = covariance @ explained
    return x, covariance, float(b @ b - explained @ x)


def covariance_root(C: Array) -> Array:
    """Return R (n, n) with R R' = C, which may be singular; raises InputError."""
    value, vectors = np.linalg.eigh((C + C.T) / 2)
    if value[0] < -1e-9 * value[-1]:
        raise InputError('the covariance of the calibration has a negative variance, so it is not '
                         'valid: use the calibration.yaml as it was written')
    return np.asarray(vectors * np.sqrt(np.maximum(value, 0.0)))


def largest_displacement(lever: Array, move: Array, C: Array) -> tuple[float, float]:
    """Return the largest displacement (m) by a move (6,) of covariance C, and its 1 sigma."""
    sizes = np.linalg.norm(se3.perturbation_jacobian(lever) @ move, axis=1)
    worst = np.argmax(sizes)
    return float(sizes[worst]), float(se3.mapped_std(lever[worst, None], C))


class GroupFit(NamedTuple, Generic[Result]):
    """
    The fit of some groups (result), with what the outlier test needs.

    That is m white residuals, their derivatives (m, k) by all unknowns in prior sigmas, and the
    group (m,) of each residual.
    """

    result: Result
    residuals: Array
    wrt_unknowns: Array
    group: Indices


def fit_without_outliers(groups: Indices, fit_groups: Callable[[Indices], GroupFit[Result]]
                         ) -> tuple[Result, dict[int, float], list[int]]:
    """
    Return the fit of the groups that agree, the p-value of each group, and the contradicting ones.

    fit_groups: fits some of the groups; raises DataError for too few. The p-value of a
    contradicting one is that of the last fit in which it took part. All groups are used where too
    many contradict, or too few would be left. Raises DataError where even all are too few.
    """
    p_values, most = dict[int, float](), int(MAX_OUTLIER_SHARE * len(groups))

    def of_groups(_: object, used: Indices, dropped: dict[int, float]
                  ) -> tuple[Result, Array, Indices, list[int]]:
        fit = fit_groups(used)
        squares, degrees_of_freedom = _left_out_squares(fit, used)
        p = chi2_sf(squares * degrees_of_freedom, degrees_of_freedom)
        p_values.update(zip(used.tolist(), p.tolist(), strict=True))
        return fit.result, squares, degrees_of_freedom, [*dropped]

    with suppress(DataError):
        result, _, _, dropped = drop_outliers(
            # one more than `most` may go, which shows that there are too many
            groups, len(groups), len(groups) - most - 1, of_groups, lambda fit: fit[1:3])
        if len(dropped) <= most:
            return result, p_values, dropped
    return of_groups(None, groups, {})[0], p_values, []


def _left_out_squares(fit: GroupFit[Result], groups: Indices) -> tuple[Array, Indices]:
    """
    Return the mean square (g,) of each group's residuals, and its degrees of freedom (g,).

    The other groups predict these residuals; they are in units of the predicted variance (eq. (12)
    of docs/estimator.md). What a group alone determines is no part of it.
    """
    U, s, _ = np.linalg.svd(fit.wrt_unknowns, full_matrices=False)
    U *= s / np.hypot(s, 1.0)  # U U' r is what the unknowns take up
    left = fit.residuals - U @ (U.T @ fit.residuals)
    squares, degrees_of_freedom = np.zeros(len(groups)), np.zeros(len(groups), dtype=np.intp)
    for k, group in enumerate(groups):
        U_group, left_group = U[fit.group == group], left[fit.group == group]
        share, V = np.linalg.eigh(U_group.T @ U_group)
        by_others = share < 1 - LEFT_BY_OTHERS_SHARE  # directions that the others determine too
        b = (left_group @ U_group @ V)[by_others]
        squares[k] = left_group @ left_group + b @ (b / (1 - share[by_others]))  # Woodbury
        degrees_of_freedom[k] = len(U_group) - np.count_nonzero(~by_others)
    return squares / np.maximum(degrees_of_freedom, 1), degrees_of_freedom
