"""Where proposed poses may be, and the part of the sensor plane that is known to be seen."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, EdgePoint, FaceLine, Sample
import numpy as np
from numpy.typing import NDArray

DIRECTIONS = 32  # of the tangents that bound the view
ROOM = 0.88  # of the view that a feature is put into: the rest is for who moves the robot


@dataclass(frozen=True, eq=False)
class Limits:
    """
    What guidance.* allows around the first sample.

    first: (4, 4) pose of what carries the sensor in what carries the target; in_hand: whether
    that is the flange in the base, and not the base in the flange. reach: metres; tilt (of the
    viewing direction), turn (about it): radians.
    """

    first: Array
    in_hand: bool
    reach: float
    tilt: float
    turn: float

    def allow(self, poses: Array, X: Array) -> NDArray[np.bool_]:
        """Return which poses (n, 4, 4) like first are allowed to a sensor at X (4, 4)."""
        T, first = (poses, self.first) if self.in_hand else (
            se3.inverse(poses), se3.inverse(self.first))
        away = np.linalg.norm(T[:, :3, 3] - first[:3, 3], axis=1)
        first_sensor, sensors = self.first[:3, :3] @ X[:3, :3], poses[:, :3, :3] @ X[:3, :3]
        tilted = np.arccos(np.clip(sensors[:, :, 2] @ first_sensor[:, 2], -1.0, 1.0))
        twisted = np.abs(twist_of(first_sensor, sensors))
        return np.asarray((away <= self.reach) & (tilted <= self.tilt) & (twisted <= self.turn))


def twist_of(first: Array, R: Array) -> Array:
    """
    Return by how much (n,) rad sensors R (n, 3, 3) are turned about the viewing direction.

    The rotation from the first (3, 3) is one about the viewing direction, then a tilt.
    """
    relative = first.T @ R
    # of the quaternion only z and w, up to a factor
    z = relative[:, 1, 0] - relative[:, 0, 1]
    w = 1 + relative[:, 0, 0] + relative[:, 1, 1] + relative[:, 2, 2]
    return np.asarray(2 * np.arctan2(z, w))


def limits_of(first: Array, config: Config) -> Limits:
    """Return the limits of a configuration around the first sample's pose (4, 4), mounted."""
    keys = config.guidance
    return Limits(first, config.calibration_type == 'eye_in_hand', keys.reach, keys.tilt,
                  keys.turn)


@dataclass(frozen=True, eq=False)
class View:
    """
    A convex part of the sensor plane: p with normals @ p <= offsets.

    normals: (d, 2) unit vectors; offsets: (d,); low, high: (2,) corners of the box around it.
    """

    normals: Array
    offsets: Array
    low: Array
    high: Array

    @property
    def size(self) -> Array:
        """Return width and depth, (2,)."""
        return np.asarray(self.high - self.low)

    def shrunk(self, border: float) -> View:
        """Return the view without a border of so much (m), nowhere less than half of it."""
        border = min(border, float(self.size.min()) / 4)
        return View(self.normals, self.offsets - border, self.low + border, self.high - border)

    def inner(self) -> View:
        """Return the view that leaves room for who moves the robot."""
        middle = (self.low + self.high) / 2
        offsets = self.normals @ middle + ROOM * (self.offsets - self.normals @ middle)
        half = ROOM * self.size / 2
        return View(self.normals, offsets, middle - half, middle + half)

    def room(self, points: Array) -> Array:
        """Return how far points (..., 2) are from the border, negative outside: (...)."""
        return np.asarray((self.offsets - points @ self.normals.T).min(axis=-1))


def seen_points(sample: Sample) -> Array:
    """Return points (n, 2) that span the features of a sample."""
    points: list[Array] = []
    for f in sample.features:
        if isinstance(f, FaceLine):
            reach = 3 ** 0.5 * f.spread * f.direction  # half its length, were it sampled evenly
            points += [f.centre - reach, f.centre + reach]
        elif isinstance(f, EdgePoint):
            points.append(f.point)
        elif isinstance(f, Arc):
            points += [*f.raw[[0, -1]], *f.points]
    return np.array(points).reshape(-1, 2)


def tangents() -> Array:
    """Return the directions (d, 2) in which a view ends."""
    turn = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    return np.column_stack([np.cos(turn), np.sin(turn)])


def extremes(points: Array) -> Array:
    """Return the few of points (n, 2), rows with NaN left out, that a view is learnt from."""
    finite = points[np.isfinite(points).all(axis=1)]
    return finite[np.unique((finite @ tangents().T).argmax(axis=0))] if len(finite) else finite


def learn_view(samples: Sequence[Sample], seen: Array | None = None) -> View:
    """
    Return the view that holds the features of samples and points seen (n, 2) of profiles.

    There must be one sample, or one point, at least.
    """
    found = [seen_points(sample) for sample in samples]
    points = np.concatenate([*found, *([] if seen is None else [extremes(seen)])])
    normals = tangents()
    return View(normals, (points @ normals.T).max(axis=0), points.min(axis=0),
                points.max(axis=0))
