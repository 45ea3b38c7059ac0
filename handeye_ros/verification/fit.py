# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Fits a shape to measured points, and estimates the calibration error from the deviations.

The calibration is fixed, as it is in use. The parameters q of the shape minimise the distances
r = d(p, q), weighted by the noise of sensor and robot. Whitened by groups of poses, a shape that
is off by dq has r = J dq + E e + n: e are the errors of the calibration and the smooth ones of the
robot, n the noise of unit covariance. The error of the fitted q is -pinv(J) (E e + n), and what is
left of the distances is M (E e + n), M = I - J pinv(J). An error of the calibration enters through
E: its stated covariance is never part of the measurement's own uncertainty.

That e is as small as the covariance of the calibration states, beside robot errors of unit
variance, is tested by the deviations v of the measured values from their nominal ones: v' cov^-1 v
is chi square if it is true. This test gives a remark, not the verdict.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
import math
from typing import NamedTuple

from handeye_ros import se3
from handeye_ros.arithmetic import rms
from handeye_ros.data import Array
from handeye_ros.estimation.blocks import wrt_smooth
from handeye_ros.estimation.least_squares import (
    chi2_sf,
    Evaluation,
    identity,
    inverse_roots,
    LeastSquares,
    Whitener,
)
from handeye_ros.estimation.noise import (
    factors_but_local_distortion,
    NoiseModel,
    total_covariance,
    Whitening,
)
from handeye_ros.estimation.problem import Estimate, Linearisation, StationGroup
from handeye_ros.frames import direction_in_words, mount_frame
from handeye_ros.targets.profile_target import grazing
from handeye_ros.verification.group_fit import (
    covariance_root,
    GroupFit,
    largest_displacement,
    regularised_least_squares,
)
from handeye_ros.verification.station_set import StationSet
import numpy as np
import scipy.linalg
from scipy.special import chdtri, chndtrinc

SIGNIFICANCE = 0.01  # level of the tests of a calibration error
INCONSISTENT_P = 1e-3  # level of the test that the points agree
# an error of so many sigma is found with 95 %: p_chance, the test of its 6 unknowns together, then
# is at most SIGNIFICANCE (noncentral chi2)
DETECTION_SIGMAS = math.sqrt(chndtrinc(chdtri(6, SIGNIFICANCE), 6, 0.05))
# and one of so many in half of the cases
EVEN_CHANCE_SIGMAS = math.sqrt(chndtrinc(chdtri(6, SIGNIFICANCE), 6, 0.5))
COVERAGE_FACTOR = 2.0  # coverage factor of expanded uncertainties (GUM: about 95 %)
DIFFERENCE_STEP = 1e-7  # of numeric derivatives (m, rad)
REFIT_COUNT = 5  # iterations for the calibration's error
MAX_SHIFT = 0.1  # m: no calibration error is larger
ERROR_PRIOR_STDS = np.repeat([0.01, 0.1], 3)  # m, rad: of a calibration in use
UNSEEN_CHANGE = 1e-6  # change of a value that no distance shows, per unit of an unknown
# 1 sigma of an unknown without a prior, in units of the sigma by which the residuals show it
FREE_STD = 1e6
# noise.distortion is here, and of faces alone, what makes steep ones uncertain (`_covariance`)
WITHOUT_LOCAL_DISTORTION = NoiseModel(factors_but_local_distortion(0.0))


@dataclass(frozen=True)
class Quantity:
    """
    A measured value with its nominal value; metres, or radians where unit is rad.

    std: 1 sigma of the deviation by sensor, robot and nominal value, infinite for a value that the
        points leave open
    std_by_calibration: 1 sigma by the calibration's covariance
    nominal: None where there is none
    characteristic: its symbol in VDI/VDE 2634 or ISO 10360 (see result_file.py)
    """

    name: str
    value: float = math.nan
    std: float = math.nan
    std_by_calibration: float = 0.0
    nominal: float | None = None
    unit: str = 'm'
    characteristic: str = ''

    @property
    def deviation(self) -> float | None:
        """Return value less nominal."""
        return None if self.nominal is None else self.value - self.nominal

    @property
    def expanded(self) -> float:
        """Return the expanded uncertainty of the measurement, k times std."""
        return COVERAGE_FACTOR * self.std


@dataclass(frozen=True, eq=False)
class Shape:
    """
    A shape with k unknowns, and the stations whose points lie on it.

    start: (k,) the unknowns q to start from
    distance(p, q): the signed distances (m,) of points p (m, 3) in the base from the shape, in
        metres
    values(q): the measured values; quantities: name, unit and nominal value of each value
    """

    stations: StationSet
    start: Array
    distance: Callable[[Array, Array], Array]
    values: Callable[[Array], Array] = lambda q: np.empty(0)
    quantities: tuple[Quantity, ...] = ()

    def wrt_point(self, p: Array, q: Array) -> Array:
        """Return the derivatives (m, 3) of the distances by the points p (m, 3)."""
        return derivatives(lambda shift: self.distance(p + shift, q), np.zeros(3))

    def linear(self, X: Array, q: Array) -> Linearisation:
        """
        Return the distances and their derivatives, with the sensor plane at X (4, 4).

        The state of the estimate is q; columns: 6 of X, then those of q.
        """
        problem = self.stations.problem
        p, (R, _) = problem.points_in_base(X), problem.mounts_of_rows
        lever, wrt_base = problem.observations.points @ X[:3, [0, 2]].T, self.wrt_point(p, q)
        wrt_mount = np.einsum('mji,mj->mi', R, wrt_base)
        wrt_shape = derivatives(partial(self.distance, p), q)
        return Linearisation(problem, Estimate(X, q), self.distance(p, q),
                             np.hstack([wrt_mount, np.cross(lever, wrt_mount), wrt_shape]), lever,
                             wrt_base)

    def fit_unknowns(self, p: Array, white: Callable[[Array], Whitener] = lambda q: identity,
                     iterations: int = 50) -> Array:
        """Return the unknowns (k,) that fit points p (m, 3) best; white(q) whitens distances."""
        distance = partial(self.distance, p)
        return LeastSquares[Array](
            lambda q: Evaluation(
                distance(q), partial(derivatives, distance, q), partial(white, q)),
            np.add, np.zeros(len(p), dtype=np.intp)).minimised(self.start, iterations=iterations)


def derivatives(function: Callable[[Array], Array], q: Array) -> Array:
    """Return the central differences (m, k) of a function at q (k,)."""
    return np.stack([(function(q + d) - function(q - d)) / (2 * DIFFERENCE_STEP)
                     for d in DIFFERENCE_STEP * np.eye(len(q))], axis=1)


@dataclass(frozen=True)
class Scatter:
    """
    How far the measured points are from the fitted shape: statistics of |distance| (m).

    p: probability that they disagree at least as much, if the uncertainties are as stated.
    """

    points: int
    mean: float
    std: float
    rms: float
    maximum: float
    p: float


class Misalignment(NamedTuple):
    """
    The error of the calibration that the distances of a shape suggest, whatever its covariance.

    twist: (6,) the most likely error, of the sensor plane in the mount (m, rad)
    p_explained: probability of larger distances from the shape with this error
    p_chance: probability that chance looks at least as much like an error
    largest, largest_std: the largest displacement of a point by the error, and its 1 sigma (m)
    weakest: (6,) the smallest error that would be found with 95 %, in the direction in which it
        shows least (m, rad)
    smallest_detectable: its size, the RMS displacement of the points (m)
    weakest_direction: its direction in words
    """

    twist: Array
    p_explained: float
    p_chance: float
    largest: float
    largest_std: float
    weakest: Array
    smallest_detectable: float
    weakest_direction: str

    @property
    def even_chance(self) -> float:
        """Return the size of an error in this direction that is found in half of the cases (m)."""
        return self.smallest_detectable * EVEN_CHANCE_SIGMAS / DETECTION_SIGMAS


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """
    Result of a fit of a shape to m points.

    quantities: those of the shape, as measured
    scatter: statistics of the distances
    distances: (m,) from the points to the shape, in metres
    distance_stds: (m,) 1 sigma of the distances due to sensor and robot, in metres
    chi2: (v - nominal)' cov^-1 (v - nominal) of the values v with a nominal, cov the sum of their
        covariances by measurement and calibration
    degrees_of_freedom: of chi2, the number of values with a nominal
    p_calibration: probability of a larger chi2 if the calibration's covariance is true
    misalignment: of the sensor, that the distances suggest
    """

    quantities: tuple[Quantity, ...]
    scatter: Scatter
    distances: Array
    distance_stds: Array
    chi2: float
    degrees_of_freedom: int
    p_calibration: float
    misalignment: Misalignment


def fit_shape(shape: Shape, X: Array, C: Array, robot_smooth: float
              ) -> GroupFit[tuple[Shape, ShapeFit]]:
    """
    Return a shape with its fit, and what the test for outliers needs, as a GroupFit.

    Raises InputError for an impossible covariance.

    X: (4, 4) sensor plane in the mount; C: (6, 6) its covariance; robot_smooth: 1 sigma (m) of the
    smooth error of the robot. The settings of the stations hold the uncertainty of nominal values.
    """
    stations, problem = shape.stations, shape.stations.problem
    # of groups of poses with one error of the robot: those of as many rows together
    batches = replace(problem.observations, station=stations.group_of_point).station_groups

    def whitening(linear: Linearisation) -> Whitening:
        return Whitening(tuple(batch.rows for batch in batches), tuple(
            inverse_roots(_covariance(linear, batch)) for batch in batches))

    q = shape.fit_unknowns(problem.points_in_base(X), lambda q: whitening(shape.linear(X, q)))
    linear = shape.linear(X, q)
    basis = problem.smooth_error_basis[problem.observations.station]
    by_robot = wrt_smooth(linear.wrt_pose, basis * robot_smooth)
    white = whitening(linear)
    r, J = white(linear.residuals), white(linear.jacobian[:, 6:])
    E = white(np.hstack([linear.jacobian[:, :6], by_robot]))
    # R R' is the covariance of e that the calibration states
    calibration_root = scipy.linalg.block_diag(covariance_root(C), np.eye(by_robot.shape[1]))
    # by how much the fitted q follows each distance
    gain = np.asarray(np.linalg.pinv(J), dtype=float)

    quantities, deviation, deviation_wrt_errors, chi2 = _measured(
        shape, q, J, gain, E, calibration_root)
    known = len(deviation)
    p_calibration = float(chi2_sf(chi2, known)) if known else 1.0

    # what the shape does not take up
    r_left, E_left = (values - J @ (gain @ values) for values in (r, E))
    degrees_of_freedom = max(len(r_left) - len(q), 1)
    sizes = np.abs(linear.residuals)
    square = regularised_least_squares(E_left @ calibration_root, r_left)[2]
    scatter = Scatter(len(sizes), float(sizes.mean()), float(sizes.std()), rms(sizes),
                      float(sizes.max()), float(chi2_sf(square, degrees_of_freedom)))
    variances = np.square(by_robot).sum(axis=1)  # of the distances, due to robot and sensor
    for batch in batches:
        variances[batch.rows] += np.einsum('nii->ni', _covariance(linear, batch))
    misalignment = _misalignment(
        np.vstack([E_left, deviation_wrt_errors]), np.append(r_left, deviation),
        degrees_of_freedom + known, linear)
    fit = ShapeFit(quantities, scatter, linear.residuals, np.sqrt(variances), chi2, known,
                   p_calibration, misalignment)

    # the test for outliers leaves shape and calibration free
    unknowns = np.hstack([J, E[:, :6]])
    unknowns *= FREE_STD / np.maximum(np.linalg.norm(unknowns, axis=0), 1e-300)
    return GroupFit((shape, fit), r, np.hstack([unknowns, E[:, 6:]]), stations.group_of_point)


def _misalignment(A: Array, b: Array, conditions: int, linear: Linearisation) -> Misalignment:
    """
    Return the error of the calibration that distances and nominal values show.

    b (n,): the white distances and the white deviations from nominal, without what the shape takes
    up: b = A e + noise, with the errors e of calibration and robot; A: (n, 6 + s). conditions: n
    without the number of unknowns that the shape takes up.
    """
    information = np.append(ERROR_PRIOR_STDS ** -2.0, np.ones(A.shape[1] - 6))
    errors, covariance, square = regularised_least_squares(A, b, information)
    twist, covariance = errors[:6], covariance[:6, :6]
    square -= float(twist ** 2 @ information[:6])
    _, _, square_without = regularised_least_squares(A[:, 6:], b, information[6:])
    degrees_of_freedom = max(conditions - 6, 1)
    factor = max(square / degrees_of_freedom, 1.0)
    p_explained = float(chi2_sf(square, degrees_of_freedom))
    # what chance does not explain, as a wrong nominal value, is no noise that hides an error
    noise_factor = factor if p_explained > INCONSISTENT_P else 1.0
    weakest, size, direction = _weakest(
        noise_factor * covariance, linear.lever, mount_frame(linear.problem.config))
    covariance *= factor
    return Misalignment(
        twist, p_explained,
        float(chi2_sf((square_without - square) / factor, 6)),
        *largest_displacement(linear.lever, twist, covariance), weakest, size, direction)


def _covariance(linear: Linearisation, batch: StationGroup) -> Array:
    """Return the covariance (groups, c, c) of noise and range errors of steep faces."""
    total = total_covariance(linear, batch, WITHOUT_LOCAL_DISTORTION)
    for block in grazing(linear):
        columns = block.columns[batch.rows] * block.largest_tau_squared ** 0.5
        total += columns @ np.swapaxes(columns, 1, 2)
    return total


def _measured(shape: Shape, q: Array, J: Array, gain: Array, E: Array, calibration_root: Array
              ) -> tuple[tuple[Quantity, ...], Array, Array, float]:
    """
    Return the measured quantities of a shape q (k,), and how the v with a nominal value deviate.

    That is the white deviations (v,), their derivatives (v, 6 + s) by e, and the chi2 of a
    ShapeFit. J (m, k), E (m, 6 + s): white derivatives of the distances; gain: pinv(J);
    calibration_root: R (6 + s, 6 + s) with R R' the covariance of e that the calibration states.
    """
    certificate = shape.stations.problem.config.verify.certificate  # U of nominal lengths
    values, wrt_shape = shape.values(q), derivatives(shape.values, q)
    wrt_distances = wrt_shape @ gain
    wrt_errors = wrt_distances @ E
    of_calibration, by_smooth = np.split(wrt_errors @ calibration_root, [6], axis=1)
    covariance, by_calibration = (A @ A.T for A in (wrt_distances, of_calibration))
    unseen = np.abs(wrt_shape - wrt_distances @ J).max(axis=1, initial=0.0) > UNSEEN_CHANGE
    nominal = np.array([quantity.nominal for quantity in shape.quantities], dtype=float)
    known = np.flatnonzero(np.isfinite(nominal) & ~unseen)
    is_length = np.array([quantity.unit == 'm' for quantity in shape.quantities])
    covariance[known, known] += is_length[known] * (certificate / COVERAGE_FACTOR) ** 2
    deviation, block = (values - nominal)[known], np.ix_(known, known)
    # by sensor and single poses alone: the smooth error is one of e, whose derivatives are
    # returned too
    whiten = np.linalg.inv(np.linalg.cholesky(covariance[block]))
    covariance += by_smooth @ by_smooth.T
    total = (covariance + by_calibration)[block]
    chi2 = float(deviation @ np.linalg.solve(total, deviation))
    covariance[unseen, unseen] = np.inf
    stds = [np.sqrt(np.maximum(np.diag(C), 0.0)).tolist() for C in (covariance, by_calibration)]
    quantities = tuple(
        replace(quantity, value=value, std=std, std_by_calibration=std_by_calibration)
        for quantity, value, std, std_by_calibration in zip(
            shape.quantities, values.tolist(), *stds, strict=True))
    return quantities, whiten @ deviation, -(whiten @ wrt_errors[known]), chi2


def _weakest(covariance: Array, lever: Array, mount: str) -> tuple[Array, float, str]:
    """
    Return weakest, smallest_detectable and weakest_direction of a Misalignment.

    covariance (6, 6): of the calibration's error, in its mount; lever (m, 3): from the sensor.
    """
    mean_square = se3.mean_square_form(lever)
    mean_square += 1e-12 * np.trace(mean_square) * np.eye(6)
    power, directions = scipy.linalg.eigh(np.linalg.inv(covariance), mean_square)
    worst = directions[:, 0]  # displaces the points by 1 m RMS
    by_rotation = np.sqrt(worst[3:] @ mean_square[3:, 3:] @ worst[3:])
    motion, axis = (('position along', worst[:3]) if np.linalg.norm(worst[:3]) >= by_rotation else
                    ('rotation about', worst[3:]))
    size = DETECTION_SIGMAS / math.sqrt(max(power[0], 1e-12))
    return size * worst, size, f'{motion} {direction_in_words(axis, mount)}'


def refit_shape(shape: Shape, X: Array, C: Array, robot_smooth: float) -> ShapeFit:
    """
    Return the fit with the calibration error estimated as well.

    One that moves a point by MAX_SHIFT or more is not followed: the fit that suggests it is
    returned.
    """
    for _ in range(REFIT_COUNT):
        _, fit = fit_shape(shape, X, C, robot_smooth).result
        if not fit.misalignment.largest < MAX_SHIFT:
            break
        X = se3.perturb(X, -fit.misalignment.twist)
    return fit
