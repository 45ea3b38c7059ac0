"""
The problem, and its residuals and derivatives at an estimate: (1), (2) of estimator.md.

A point s = (x, 0, z) of the sensor plane is mapped to the base, p = R_i (X s) + a_i, and has to
satisfy a condition g(p) = 0.
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.estimation.basis import farthest_points, pose_features, process_root
from handeye_ros.estimation.jacobian import products, Stations, stations_of
from handeye_ros.estimation.model import Estimate, Method, Observations, PoseModel
import numpy as np
from numpy.typing import NDArray

MANY = 200  # stations: more of them change variance factors by less than 1 % of a sigma


@dataclass(frozen=True, eq=False)
class Problem:
    """
    A calibration problem: poses (n, 4, 4) of the mount, their observations, and settings.

    pose_model: parameters that the poses depend on, or None; pose_values: (k,) their values.
    long_errors: whether the robot's smooth error has long wavelengths only.
    """

    method: Method
    poses: Array
    observations: Observations
    config: Config
    pose_model: PoseModel | None = None
    pose_values: Array = field(default_factory=lambda: np.zeros(0))
    long_errors: bool = False

    def __post_init__(self) -> None:
        """Set pose_values to 0 if there is a pose model and no values are given."""
        if self.pose_model is not None and not len(self.pose_values):
            object.__setattr__(self, 'pose_values', np.zeros(sum(self.pose_model.counts)))

    @cached_property
    def columns(self) -> NDArray[np.intp]:
        """Return the columns of the Jacobian that belong to unknowns."""
        free = self.method.geometry.free(self.config)
        return np.concatenate([np.arange(6), 6 + np.flatnonzero(free)])

    @cached_property
    def flanges(self) -> tuple[Array, Array]:
        """Return rotation (m, 3, 3) and position (m, 3) of each observation's flange."""
        T = self.poses[self.observations.station]
        return np.ascontiguousarray(T[:, :3, :3]), T[:, :3, 3].copy()

    @cached_property
    def by_columns(self) -> Array:
        """Return derivatives (9, m * 3) of the points in the base by the columns x, z, t of X."""
        x, z = self.observations.points.T[:, :, None, None]
        R, _ = self.flanges
        return np.stack([R * x, R * z, R]).transpose(0, 3, 1, 2).reshape(9, -1)

    @cached_property
    def stations(self) -> tuple[Stations, ...]:
        """Return the observations by station, grouped by their number."""
        return stations_of(self.observations)

    @cached_property
    def distinct(self) -> list[int]:
        """Return the stations of distinct poses, at most MANY."""
        return farthest_points(pose_features(self.poses), MANY)

    @cached_property
    def ambiguous(self) -> bool:
        """Return whether stations show several similar surfaces; only one is the target."""
        return self.method.geometry.ambiguous(self.observations)

    @property
    def few(self) -> bool:
        """Return whether the problem may have several solutions and needs more starts."""
        return len(self.poses) <= 12

    @property
    def in_hand(self) -> bool:
        """Return whether the sensor is on the flange; else the poses are inverted."""
        return self.config.calibration_type == 'eye_in_hand'

    @cached_property
    def robot_poses(self) -> Array:
        """Return the poses (n, 4, 4) of the flange in the base, for either calibration type."""
        return self.poses if self.in_hand else se3.inverse(self.poses)

    @cached_property
    def smooth(self) -> Array:
        """Return basis functions (n, r) of the robot's smooth error at the poses."""
        return process_root(self.robot_poses, self.long_errors)

    @cached_property
    def smooth_products(self) -> Array:
        """Return the pairwise products (n, r * r) of the basis functions `smooth`."""
        return products(self.smooth)

    @cached_property
    def of_long_errors(self) -> Problem:
        """Return the problem for the report, with robot errors of long wavelength only."""
        return replace(self, long_errors=True)

    @property
    def tolerances(self) -> Array:
        """Return 1 sigma (k,) of the target's stated parameters, 0 for others."""
        stated = self.method.measures.tolerances(self.config)
        return stated if len(stated) else np.zeros(len(self.method.labels))

    @property
    def shows_essential(self) -> NDArray[np.bool_]:
        """Return which stations (n,) have an observation of an essential kind."""
        method, obs = self.method, self.observations
        of_kind = np.array([*(name in method.essential for name in method.kinds), False])  # UNUSED
        shows = np.zeros(len(self.poses), dtype=bool)
        shows[obs.station[of_kind[obs.kind]]] = True
        return shows

    def guesses(self, rng: np.random.Generator) -> Iterator[Estimate]:
        """Return an iterator over starts, best first, computed on demand."""
        return iter(self.method.guess(self, rng))

    def points_in_base(self, X: Array) -> Array:
        """Return the observed points (m, 3) in the base."""
        return self.observations.in_base(self.poses, X)

    def retracted(self, estimate: Estimate, step: Array) -> Estimate:
        """Return the estimate, or several, after a step (..., u) in the unknown columns."""
        delta = np.zeros((*step.shape[:-1], 6 + len(self.method.labels)))
        delta[..., self.columns] = step
        return Estimate(se3.perturb(estimate.X, delta[..., :6]),
                        self.method.geometry.retract(estimate.target, delta[..., 6:]))

    def with_pose_values(self, values: Array) -> Problem:
        """Return the problem with the poses of its pose model at values (k,)."""
        assert self.pose_model is not None
        poses, _ = self.pose_model.at(values)
        other = replace(self, poses=poses if self.in_hand else se3.inverse(poses),
                        pose_values=values)
        # such small changes of the poses hardly change the basis, and not the observations
        vars(other).update(smooth=self.smooth, smooth_products=self.smooth_products,
                           stations=self.stations)
        return other

    def subset(self, stations: NDArray[np.intp]) -> Problem:
        """Return the problem with only the given stations (ascending indices)."""
        if len(stations) == len(self.poses):
            return self
        fewer = self.observations.select(np.isin(self.observations.station, stations))
        renumbered = np.searchsorted(stations, fewer.station)
        model = self.pose_model and self.pose_model.subset(stations)
        return replace(self, poses=self.poses[stations], pose_model=model,
                       observations=replace(fewer, station=renumbered))


@dataclass(frozen=True, eq=False)
class State:
    """An estimate, and the values of the blocks that retract, by name, in their own units."""

    problem: Problem
    estimate: Estimate
    values: Mapping[str, Array]

    @classmethod
    def of(cls, problem: Problem, estimate: Estimate) -> State:
        """Return the state of a problem with its pose values; all other blocks are 0."""
        model = problem.pose_model
        split = np.split(problem.pose_values, np.cumsum(model.counts)[:-1]) if model else []
        return cls(problem, estimate, dict(zip(model.names if model else (), split, strict=True)))


@dataclass(frozen=True, eq=False)
class Linear:
    """
    Residuals (..., m) at an estimate, and their Jacobian (..., m, 6 + k) by X and target.

    lever: (..., m, 3) from the sensor's origin to the points, in the mount; by_base: (..., m, 3)
    derivatives by the points in the base.
    """

    problem: Problem
    estimate: Estimate
    residuals: Array
    jacobian: Array
    lever: Array
    by_base: Array

    @cached_property
    def by_pose(self) -> Array:
        """Return derivatives (..., m, 6) by pose errors: base frame, rotation about the flange."""
        R, a = self.problem.flanges
        to_point = np.einsum('mij,...mj->...mi', R, self.lever + self.estimate.X[..., None, :3, 3])
        if self.problem.in_hand:
            return np.concatenate([self.by_base, se3.cross(to_point, self.by_base)], axis=-1)
        # the poses are T_flange_base; the robot's error is in its base frame
        by_mount = self.jacobian[..., :3]
        p_base = np.einsum('mji,...mj->...mi', R, to_point + a)
        return -np.concatenate([by_mount, se3.cross(p_base, by_mount)], axis=-1)

    @cached_property
    def by_values(self) -> Array | None:
        """Return derivatives (m, k) by 1 sigma of the white errors of pose values, or None."""
        model = self.problem.pose_model
        if model is None or model.white is None:
            return None
        return self.by_twists(model.at(self.problem.pose_values)[1] * model.white)

    @cached_property
    def by_point(self) -> Array:
        """Return the derivative (..., m, 2) by the point of the sensor plane."""
        return np.asarray(self.jacobian[..., :3] @ self.estimate.X[..., :3, [0, 2]])

    @cached_property
    def by_feature(self) -> Array:
        """Return the derivative (..., m, 2) by the feature's unit errors."""
        noise = self.problem.observations.noise
        return np.asarray(np.einsum('...mi,mij->...mj', self.by_point, noise))

    @cached_property
    def points_on_target(self) -> Array:
        """
        Return the points (m, 2) of the sensor's plane moved to where their conditions hold.

        Errors of the measured points themselves would make least squares shrink all lengths.
        """
        g = self.by_point
        square = (g ** 2).sum(axis=1)
        share = np.divide(self.residuals, square, out=np.zeros(len(g)), where=square > 0)
        return np.asarray(self.problem.observations.points - g * share[:, None])

    def by_twists(self, twists: Array) -> Array:
        """Return the derivatives (m, k) by parameters that move the poses by twists (n, 6, k)."""
        station = self.problem.observations.station
        return np.asarray((self.by_pose[:, None] @ twists[station])[:, 0])


def linearise(problem: Problem, estimate: Estimate) -> Linear:
    """
    Return residuals and derivatives r, J at an estimate, (2).

    Or at several estimates at once, X (n, 4, 4) and target (n, s), where the method allows that.
    """
    obs, X = problem.observations, estimate.X
    R, a = problem.flanges
    columns = np.swapaxes(X[..., :3, [0, 2, 3]], -1, -2)
    lever = obs.points @ columns[..., :2, :]
    turned = columns.reshape(*X.shape[:-2], 9) @ problem.by_columns
    p = turned.reshape(*X.shape[:-2], len(obs), 3) + a
    conditions = problem.method.geometry.conditions(p, obs.kind, estimate.target, problem.config)
    by_mount = np.einsum('mji,...mj->...mi', R, conditions.dg_dp)
    jacobian = np.concatenate([by_mount, se3.cross(lever, by_mount), conditions.dg_dtarget],
                              axis=-1)
    return Linear(problem, estimate, conditions.g, jacobian, lever, conditions.dg_dp)
