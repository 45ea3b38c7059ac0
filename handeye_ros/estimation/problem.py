# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What is observed of a target, the problem, and its residuals and derivatives: (1), (2).

A point s = (x, 0, z) of the sensor plane is mapped to the base, p = R_i (X s) + a_i, and has to
satisfy a condition g(p) = 0. The *base* is the frame in which the target is fixed: with
eye_on_base the flange, and the mount is the robot's base. What is said of the robot itself (a
PoseModel, `robot_poses`, `wrt_pose`) stays in the robot's base. The numbers are those of
docs/estimator.md.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Self, TYPE_CHECKING

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array
from handeye_ros.estimation.basis import smooth_basis
from handeye_ros.estimation.least_squares import rows_by_count
from handeye_ros.estimation.target import Target, target_pose
from handeye_ros.frames import mount_poses
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from handeye_ros.estimation.blocks import ParameterBlock

UNUSED = -1  # the kind of an observation that is not part of the target
# So many tell noise and taus; of a sweep, fewer: neighbours on a path tell little new.
ENOUGH_STATIONS, ENOUGH_PROFILES = 200, 100
FEW_STATIONS = 12  # so few fit in several wrong ways
DISTORTION_LENGTH = 0.01  # m: the distortion of points 12 mm apart has the correlation 0.5
SAME_POINT = 1e-9  # m: conditions of one feature that are nearer are on one point


@dataclass(frozen=True, eq=False)
class StationGroup:
    """
    s stations with c observations each.

    stations: (s,) their numbers
    rows: (s, c) row numbers
    correlation: (s, c, c) of the distortion
    same_point: (s, c, c) 1 where two observations are on one point, whose error they share
    factor_masks: (2, s, c, c) 1 where both observations are of faces or arcs, or both are edge
        points: each has a variance factor
    """

    stations: NDArray[np.intp]
    rows: NDArray[np.intp]
    correlation: Array
    same_point: Array
    factor_masks: Array


@dataclass(frozen=True, eq=False)
class Observations:
    """
    Points of the sensor plane, each with one scalar condition.

    station: (m,) index of the pose, ascending
    points: (m, 2) metres
    kind: (m,) index of the condition in the target's kinds
    error_root: (m, 2, 2) root L: the point's error is L @ e, e of unit covariance
    feature: (m,) number of the feature in its sample
    ending: (m,) how the face ends at an edge point (numbered from 1), 0 for other points; edge
        points have a variance factor of their own
    outward: (m, 2) unit vector out of the face
    shape_std: (m,) 1 sigma of the outward edge position from the uncertain shape, common to all
        edges
    """

    station: NDArray[np.intp]
    points: Array
    kind: NDArray[np.intp]
    error_root: Array
    feature: NDArray[np.intp]
    ending: NDArray[np.intp]
    outward: Array
    shape_std: Array

    @classmethod
    def concatenated(cls, parts: Sequence[Observations]) -> Self:
        """Return the observations of one or more parts, in order."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts])
                     for f in fields(cls)))

    def __len__(self) -> int:
        """Return the number of conditions."""
        return len(self.station)

    @cached_property
    def station_groups(self) -> tuple[StationGroup, ...]:
        """Return the stations, grouped by their number of observations."""
        grouped = []
        for rows in rows_by_count(self.station):
            points, feature = self.points[rows], self.feature[rows]
            is_edge = self.ending[rows] > 0
            apart = points[:, :, None] - points[:, None, :]
            squared = np.einsum('nijk,nijk->nij', apart, apart)
            correlation = np.exp(-0.5 * squared / DISTORTION_LENGTH ** 2)
            same_feature = feature[:, :, None] == feature[:, None, :]
            same_point = (same_feature & (squared < SAME_POINT ** 2)).astype(float)
            pairs = [mask[:, :, None] & mask[:, None, :] for mask in (~is_edge, is_edge)]
            grouped.append(StationGroup(self.station[rows[:, 0]], rows, correlation, same_point,
                                        np.array(pairs, dtype=float)))
        return tuple(grouped)

    def same(self, other: Observations) -> bool:
        """Return whether others are the same points with the same kinds."""
        return (np.array_equal(self.kind, other.kind)
                and np.array_equal(self.station, other.station)
                and np.array_equal(self.points, other.points))

    def select(self, keep: NDArray[np.bool_ | np.intp]) -> Self:
        """Return some observations, by a mask or by their numbers."""
        return type(self)(*(getattr(self, f.name)[keep] for f in fields(self)))

    def repeated(self, stations: int, points: Array) -> Self:
        """Return the observations of one station repeated, with points (stations * m, 2)."""
        many = self.select(np.tile(np.arange(len(self)), stations))
        return replace(many, points=points, station=np.repeat(np.arange(stations), len(self)))


@dataclass(frozen=True, eq=False)
class PoseModel:
    """
    Poses of a moving robot, which depend on parameters with a prior, such as a time offset.

    evaluate(pose_parameters (k,)): poses T_base_flange (N, 4, 4) of all samples, and twists
    (N, 6, k), their derivatives by the parameters: translation, and rotation vector about the
    flange's origin, both in the robot's base.

    names (k,), stds (k,): 1 sigma of the prior about 0; a parameter with 0 is known
    jitter: (k,) 1 sigma of independent errors of the parameters at each station, as of stamps;
        None: none
    stations: indices of the problem's stations among the N
    least_tau_squared: see ParameterBlock
    blocks: source of further blocks for such poses, or None
    """

    evaluate: Callable[[Array], tuple[Array, Array]]
    names: tuple[str, ...]
    stds: tuple[float, ...]
    stations: NDArray[np.intp]
    least_tau_squared: float = 0.0
    blocks: Callable[[Linearisation], Iterable[ParameterBlock]] | None = None
    jitter: Array | None = None

    def at(self, pose_parameters: Array) -> tuple[Array, Array]:
        """Return the poses (n, 4, 4) and twists (n, 6, k) of the stations of a problem."""
        poses, twists = self.evaluate(pose_parameters)
        return poses[self.stations], twists[self.stations]

    def subset(self, stations: NDArray[np.intp]) -> PoseModel:
        """Return the model of some of the stations."""
        return replace(self, stations=self.stations[stations])


@dataclass(frozen=True, eq=False)
class Estimate:
    """The pose X (4, 4) of the sensor plane in the mount, and the target's state (s,)."""

    X: Array
    state: Array

    @property
    def T_base_target(self) -> Array:
        """Return the pose (4, 4) of the target in the base."""
        return target_pose(self.state)


@dataclass(frozen=True, eq=False)
class Problem:
    """
    A calibration problem: poses (n, 4, 4) of the mount in the base, observations, and settings.

    pose_model: parameters that the poses depend on, set by with_pose_parameters; None: none
    pose_parameters: (k,) these
    pose_twists: (n, 6, k) derivatives of the robot's poses by these
    long_errors: whether the robot's smooth error has long wavelengths only
    """

    target: Target
    poses: Array
    observations: Observations
    config: Config
    pose_model: PoseModel | None = None
    pose_parameters: Array = field(default_factory=lambda: np.zeros(0))
    pose_twists: Array = field(default_factory=lambda: np.zeros((0, 6, 0)))
    long_errors: bool = False

    def __post_init__(self) -> None:
        """Give each pose its derivatives by no parameters, where there are none."""
        if self.pose_model is None:
            object.__setattr__(self, 'pose_twists', np.zeros((len(self.poses), 6, 0)))

    @cached_property
    def free_columns(self) -> NDArray[np.intp]:
        """Return the columns of the Jacobian that belong to unknowns."""
        stated = self.target.stated_values(self.config)
        free = [name not in stated for name in self.target.parameter_names]
        return np.concatenate([np.arange(6), 6 + np.flatnonzero(free)])

    @property
    def is_sweep(self) -> bool:
        """Return whether the robot moved at some stations: their poses depend on parameters."""
        return self.pose_model is not None

    @property
    def pose_parameter_stds(self) -> Array:
        """Return 1 sigma (k,) of the prior of the pose parameters."""
        return np.array(self.pose_model.stds if self.pose_model else ())

    @cached_property
    def mounts_of_rows(self) -> tuple[Array, Array]:
        """Return rotation (m, 3, 3) and position (m, 3) of the mount at each observation."""
        T = self.poses[self.observations.station]
        return np.ascontiguousarray(T[:, :3, :3]), T[:, :3, 3].copy()

    @cached_property
    def shows_several(self) -> bool:
        """Return whether stations show several similar surfaces; only one is the target."""
        return self.target.shows_several(self.observations)

    @property
    def needs_more_starts(self) -> bool:
        """Return whether the problem may have several solutions and needs more starts."""
        return len(self.poses) <= FEW_STATIONS

    @cached_property
    def robot_poses(self) -> Array:
        """Return T_base_flange (n, 4, 4), in the robot's base for either calibration type."""
        return mount_poses(self.poses, self.config)

    @cached_property
    def smooth_error_basis(self) -> Array:
        """Return basis functions (n, r) of the robot's smooth error at the poses."""
        return smooth_basis(self.robot_poses, self.long_errors)

    @property
    def enough_stations(self) -> int:
        """Return the number of stations that tell noise and taus."""
        return ENOUGH_PROFILES if self.is_sweep else ENOUGH_STATIONS

    @property
    def is_large(self) -> bool:
        """Return whether a part of the stations suffices to tell noise and taus."""
        return len(self.poses) >= 2 * self.enough_stations

    @property
    def shows_edge(self) -> NDArray[np.bool_]:
        """Return which stations (n,) have an observation at an edge."""
        obs, shows = self.observations, np.zeros(len(self.poses), dtype=bool)
        shows[obs.station[np.isin(obs.kind, list(self.target.edge_kinds))]] = True
        return shows

    def points_in_base(self, X: Array) -> Array:
        """Return the observed points (m, 3) in the base."""
        return mapped(self.observations.points, (self.poses @ X)[self.observations.station])

    def retracted(self, estimate: Estimate, step: Array) -> Estimate:
        """Return the estimate, or several, after a step (..., u) in the unknown columns."""
        delta = np.zeros((*step.shape[:-1], 6 + len(self.target.parameter_names)))
        delta[..., self.free_columns] = step
        return Estimate(se3.perturb(estimate.X, delta[..., :6]),
                        self.target.retract(estimate.state, delta[..., 6:]))

    def with_pose_parameters(self, pose_parameters: Array) -> Problem:
        """Return the problem with the poses of its pose model, if any, at parameters (k,)."""
        if self.pose_model is None:
            return self
        poses, twists = self.pose_model.at(pose_parameters)
        return replace(self, poses=mount_poses(poses, self.config),
                       pose_parameters=pose_parameters, pose_twists=twists)

    def subset(self, stations: NDArray[np.intp]) -> Problem:
        """Return the problem with only the given stations (ascending indices)."""
        if len(stations) == len(self.poses):
            return self
        fewer = self.observations.select(np.isin(self.observations.station, stations))
        renumbered = np.searchsorted(stations, fewer.station)
        return replace(self, poses=self.poses[stations], pose_twists=self.pose_twists[stations],
                       pose_model=self.pose_model and self.pose_model.subset(stations),
                       observations=replace(fewer, station=renumbered))


@dataclass(frozen=True, eq=False)
class Linearisation:
    """
    Residuals (..., m) in metres at an estimate, and their Jacobian (..., m, 6 + k).

    jacobian: by X and the k parameters of the target; lever: (..., m, 3) from the sensor's origin
    to the points, in the mount; wrt_base: (..., m, 3) derivatives by the points in the base.
    """

    problem: Problem
    estimate: Estimate
    residuals: Array
    jacobian: Array
    lever: Array
    wrt_base: Array

    @cached_property
    def wrt_pose(self) -> Array:
        """Return derivatives (..., m, 6) by errors of robot_poses, turned about the flange."""
        problem, in_mount = self.problem, self.lever + self.estimate.X[..., None, :3, 3]
        if problem.config.in_hand:
            R, _ = problem.mounts_of_rows
            wrt_shift, from_flange = self.wrt_base, np.einsum('mij,...mj->...mi', R, in_mount)
        else:  # the mount is the robot's base
            flange = problem.robot_poses[problem.observations.station, :3, 3]
            wrt_shift, from_flange = -self.jacobian[..., :3], in_mount - flange
        return np.concatenate([wrt_shift, np.cross(from_flange, wrt_shift)], axis=-1)

    @cached_property
    def wrt_jitter(self) -> Array | None:
        """Return derivatives (m, k) by 1 sigma of pose parameters' jitter, None without."""
        model = self.problem.pose_model
        if model is None or model.jitter is None:
            return None
        return self.wrt_twists(self.problem.pose_twists * model.jitter)

    @cached_property
    def wrt_point(self) -> Array:
        """Return the derivative (..., m, 2) by the point of the sensor plane."""
        return np.asarray(self.jacobian[..., :3] @ self.estimate.X[..., :3, [0, 2]])

    @cached_property
    def wrt_unit_errors(self) -> Array:
        """Return the derivative (..., m, 2) by the unit errors e of the point, see error_root."""
        root = self.problem.observations.error_root
        return np.asarray(np.einsum('...mi,mij->...mj', self.wrt_point, root))

    def wrt_twists(self, twists: Array) -> Array:
        """Return the derivatives (m, k) by parameters that move the poses by twists (n, 6, k)."""
        station = self.problem.observations.station
        return np.asarray((self.wrt_pose[:, None] @ twists[station])[:, 0])


def has_unused_edges(problem: Problem, assigned: Problem) -> NDArray[np.bool_]:
    """Return which stations (n,) show an edge, but of which none is assigned."""
    return problem.shows_edge & ~assigned.shows_edge


def mapped(points: Array, T: Array) -> Array:
    """Return points (m, 2) of the sensor plane mapped by transforms (m, 4, 4) of their own."""
    return np.asarray((T[:, :3, [0, 2]] @ points[:, :, None])[..., 0] + T[:, :3, 3])


def linearise(problem: Problem, estimate: Estimate) -> Linearisation:
    """
    Return residuals and derivatives r, J at an estimate, (2).

    Or at several estimates at once, X (n, 4, 4) and state (n, s), where the target can be mapped
    at several.
    """
    obs, X = problem.observations, estimate.X
    R, a = problem.mounts_of_rows
    lever = obs.points @ np.swapaxes(X[..., :3, [0, 2]], -1, -2)
    p = np.einsum('mij,...mj->...mi', R, lever + X[..., None, :3, 3]) + a
    conditions = problem.target.conditions(p, obs.kind, estimate.state, problem.config)
    wrt_mount = np.einsum('mji,...mj->...mi', R, conditions.dg_dp)
    jacobian = np.concatenate([wrt_mount, np.cross(lever, wrt_mount), conditions.dg_dparameters],
                              axis=-1)
    return Linearisation(problem, estimate, conditions.g, jacobian, lever, conditions.dg_dp)
