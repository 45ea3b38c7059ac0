# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Profiles and poses to points in the robot's base: a scan.

A message becomes a Profile with only its returns (`returns_of` in bags/messages.py). Trajectory.at
gives the flange at its stamp, and the base to the sensor is T_base_flange @ T_flange_sensor; the
two coordinates of a return count along `unit_vectors` of the profile's axes in the sensor frame.
With eye_on_base the points are in the frame of the flange, which carries the workpiece past the
sensor. The poses are interpolated by a spline at the stamp of each profile plus time_offset; the
rotation is taken later by the rotation lag that the calibration estimated. A profile outside the
poses or in a gap gives no points. Beside poses and cubes of voxels, of each profile only its stamp
and place stay in memory.
"""
from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import compress, islice

from handeye_ros import se3
from handeye_ros.config import Config, NoiseConfig
from handeye_ros.data import Array, Calibration, Profile
from handeye_ros.errors import BadValueError, DataError
from handeye_ros.frames import mount_poses, target_frame, unit_vectors
from handeye_ros.sampling.trajectory import Trajectory
from handeye_ros.scanning.cloud import Points
from handeye_ros.units import parse_length
import numpy as np
from numpy.typing import NDArray

BATCH_PROFILES = 64  # profiles at once: the arrays stay in the cache
CELL_BITS = 21  # of the number of a cube along each axis; 2 million cubes on, it is the same
SLOPE_REACH = 4  # returns to either side for the slope of the surface


@dataclass(frozen=True)
class ScanOptions:
    """
    Which points a scan keeps, and their fields.

    nearest, farthest: range along the sensor's range axis (m)
    incidence: largest angle between range axis and surface normal in the plane of the profile
        (rad)
    voxel: edge of the cubes of which each keeps one point (m), 0: all are kept
    std: whether points have a field of their 1 sigma
    """

    nearest: float = -np.inf
    farthest: float = np.inf
    incidence: float = np.pi / 2
    voxel: float = 0.0
    std: bool = False

    @classmethod
    def of_texts(cls, limits: Sequence[str], degrees: float, voxel: str, std: bool) -> ScanOptions:
        """Return the options of a command line; raises BadValueError."""
        nearest, farthest = (parse_length(text, '--range', 10.0) for text in limits)
        if nearest >= farthest:
            raise BadValueError('--range', ' '.join(limits), 'the smaller reading first')
        edge = parse_length(voxel, '--voxel', 0.1, 0.0)
        if not 0.0 <= degrees <= 90.0:
            raise BadValueError('--incidence', degrees, '0 to 90 degrees')
        return cls(nearest, farthest, float(np.deg2rad(degrees)), edge, std)


class Scanner:
    """
    Maps profiles to points in the base (with eye_on_base in the flange), live and offline.

    frame: the id of the frame of the points
    profiles, without_pose: the number of profiles so far, and of those without a pose
    returns, out_of_limits, thinned: the number of returns of the profiles with a pose, and of
        those that are dropped
    """

    def __init__(self, calibration: Calibration, config: Config, options: ScanOptions) -> None:
        """Start without profiles."""
        self.calibration, self.config, self.frame = calibration, config, target_frame(config)
        self.options = options
        self.profiles = self.without_pose = 0
        self.returns = self.out_of_limits = self.thinned = 0
        self._fields: np.dtype[np.void] | None = None  # of a point, as the first profile has them
        self._filled = set[int]()  # cubes that have their point

    @property
    def kept(self) -> int:
        """Return the number of points that were kept so far."""
        return self.returns - self.out_of_limits - self.thinned

    def scan(self, profiles: Iterable[Profile], trajectory: Trajectory) -> Iterator[Points]:
        """Yield the points of profiles of returns, in pieces; raises DataError without any."""
        source = iter(profiles)
        while batch := list(islice(source, BATCH_PROFILES)):
            yield self.mapped(batch, trajectory)
        if self.profiles == self.without_pose > 0:
            raise DataError(
                f'none of the {self.profiles} profiles has a pose before and after it within '
                f'{self.config.sampling.max_pose_gap:g} s: the clocks of sensor and robot differ '
                '(set time_offset), or the poses are too sparse (sampling.max_pose_gap)')
        if not self.kept:
            raise DataError(f'no point is left of {self.profiles} profiles with {self.returns} '
                            'returns: widen the limits (--range, --incidence), or, without '
                            'returns, check range and exposure of the sensor')

    def mapped(self, profiles: Sequence[Profile], trajectory: Trajectory) -> Points:
        """
        Return the points of one profile or more: x, y, z in `frame` (m), intensity, std (m).

        They are counted, and their cubes filled. intensity is there if the first profile of all
        has it, std if asked for.
        """
        if self._fields is None:
            optional = {'intensity': profiles[0].intensity is not None, 'std': self.options.std}
            self._fields = np.dtype([(name, '<f4') for name in (
                *'xyz', *compress(optional, optional.values()))])
        stamps = np.array([p.stamp for p in profiles], dtype=np.int64) + self.config.offset_ns
        flange = trajectory.at(stamps, self.calibration.rotation_lag)
        self.profiles += len(profiles)
        self.without_pose += len(profiles) - int(flange.inside.sum())
        T = mount_poses(flange.T_base_flange, self.config) @ self.calibration.T_flange_sensor
        stds = trajectory.std(stamps) if self.options.std else np.zeros((len(profiles), 2))
        used = compress(zip(profiles, T, stds, strict=True), flange.inside)
        cloud = np.concatenate([np.empty(0, self._fields), *(
            self._mapped_profile(self._fields, *item) for item in used)])
        return self._one_in_each_cube(cloud) if self.options.voxel > 0 else cloud

    def _one_in_each_cube(self, cloud: Points) -> Points:
        """Return the points that are the first in their cube, in the order of the cloud."""
        points = np.stack([cloud['x'], cloud['y'], cloud['z']], axis=1)
        cell = np.floor(points / self.options.voxel).astype(np.int64) & (1 << CELL_BITS) - 1
        cubes, first = np.unique(cell @ [1 << 2 * CELL_BITS, 1 << CELL_BITS, 1],
                                 return_index=True)
        is_new = np.array([cube not in self._filled for cube in cubes.tolist()], dtype=bool)
        self._filled.update(cubes.tolist())
        self.thinned += len(cloud) - int(is_new.sum())
        return np.take(cloud, np.sort(first[is_new]))

    def _mapped_profile(self, fields: np.dtype[np.void], profile: Profile, T_base_sensor: Array,
                        pose_std: Array) -> Points:
        """
        Return the points of a profile of returns, and count them.

        T_base_sensor: (4, 4); pose_std: see point_std.
        """
        keep = self._within_limits(profile.points)
        points = profile.points[keep]
        self.returns += len(keep)
        self.out_of_limits += len(keep) - len(points)
        axes = unit_vectors(profile.axes)
        R = T_base_sensor[:3, :3] @ axes
        in_base = points @ R.T + T_base_sensor[:3, 3]
        cloud = np.empty(len(points), fields)
        cloud['x'], cloud['y'], cloud['z'] = in_base.T
        if 'intensity' in (fields.names or ()):
            cloud['intensity'] = (np.nan if profile.intensity is None
                                  else profile.intensity[keep])
        if self.options.std:
            in_mount = points @ (self.calibration.T_flange_sensor[:3, :3] @ axes).T
            cloud['std'] = point_std(self.calibration, self.config.noise, in_mount, pose_std)
        return cloud

    def _within_limits(self, points: Array) -> NDArray[np.bool_]:
        """Return a mask (n,) of the returns (n, 2) within the limits (m)."""
        keep = (points[:, 1] >= self.options.nearest) & (points[:, 1] <= self.options.farthest)
        if self.options.incidence < np.pi / 2:  # only then: they take half of the time
            keep[keep] = _incidence(points[keep]) <= self.options.incidence
        return np.asarray(keep)


def _incidence(points: Array) -> Array:
    """Return the angle (n,) between range axis and surface normal at points (n, 2), rad."""
    neighbours = np.arange(len(points)) + [[-SLOPE_REACH], [SLOPE_REACH]]
    first, last = points[np.clip(neighbours, 0, len(points) - 1)]
    along, across = np.abs(last - first).T
    return np.asarray(np.arctan2(across, along))


def point_std(calibration: Calibration, noise: NoiseConfig, lever: Array, pose_std: Array
              ) -> Array:
    """
    Return 1 sigma (n,) of measured points in the base, as a length (m).

    lever: the vectors (n, 3) from the sensor to the points, in the axes of its mount (m)
    pose_std: 1 sigma (2,) of the trajectory, translation and rotation by axis (m, rad)

    The square of the result is the trace of the covariance of a point, which comes from the
    calibration, from the noise of the range and of single poses, and from the trajectory.
    """
    wrt_X = se3.perturbation_jacobian(lever)
    square = ((wrt_X @ calibration.covariance) * wrt_X).sum(axis=(1, 2)) + noise.sensor ** 2
    from_flange = ((lever + calibration.T_flange_sensor[:3, 3]) ** 2).sum(axis=1)
    for translation, rotation in ((noise.robot_translation, noise.robot_rotation), pose_std):
        square += 3 * translation ** 2 + 2 * rotation ** 2 * from_flange
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))
