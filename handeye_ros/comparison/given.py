"""What every estimator is given: the same samples, and how a transform is judged by them."""
from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

from handeye_ros.config import Config
from handeye_ros.data import Array, Sample
from handeye_ros.estimation.linearise import Problem
from handeye_ros.estimation.model import Estimate
from handeye_ros.estimation.noise import Noise
from handeye_ros.estimation.search import fit
from handeye_ros.files.method import FileMethod, plane_axes
from handeye_ros.frames import sensor_axes
from handeye_ros.results.outcome import measured_points
from handeye_ros.results.truth_file import field_points
import numpy as np
from numpy.typing import NDArray

G = TypeVar('G', bound='Given')


class Given(Protocol):
    """
    Samples that every estimator is given.

    config: the settings. T_sensor_plane: (4, 4), in which the transforms X are reported; field:
    points (k, 3) in that plane over which errors are reported.
    """

    @property
    def config(self) -> Config:
        """Return the settings."""

    @property
    def T_sensor_plane(self) -> Array:
        """Return what the transforms are turned by (4, 4)."""

    @property
    def field(self) -> Array:
        """Return the points (k, 3) over which errors are reported."""

    def __len__(self) -> int:
        """Return the number of samples."""

    def subset(self: G, samples: NDArray[np.intp]) -> G:
        """Return a part of the samples (ascending indices)."""

    def residuals(self, X: Array, fitted: NDArray[np.intp], measured: NDArray[np.intp]
                  ) -> Array | None:
        """Return by how much (m) some miss with a transform, the target fitted to others."""


@dataclass(frozen=True, eq=False)
class Known:
    """The stations as the target's own method sees them, labelled, its estimate and noise."""

    problem: Problem
    estimate: Estimate
    noise: Noise


@dataclass(frozen=True, eq=False)
class Stations:
    """
    What an estimator is given.

    samples: in the order of their stamps; known: of the same stations, in the same order, None
    where the target's own method has no answer.
    """

    samples: tuple[Sample, ...]
    config: Config
    known: Known | None = None

    @property
    def T_sensor_plane(self) -> Array:
        """Return which way the plane lies in the sensor frame (4, 4)."""
        return sensor_axes(self.config)

    @property
    def field(self) -> Array:
        """Return a grid (k, 3) over a field of view."""
        return field_points()

    def __len__(self) -> int:
        """Return the number of stations."""
        return len(self.samples)

    def subset(self, samples: NDArray[np.intp]) -> Stations:
        """Return a part of the stations (ascending indices)."""
        known = self.known and replace(self.known, problem=self.known.problem.subset(samples))
        return replace(self, samples=tuple(self.samples[i] for i in samples), known=known)

    def residuals(self, X: Array, fitted: NDArray[np.intp], measured: NDArray[np.intp]
                  ) -> Array | None:
        """Return the residuals of some stations, None where the method has no answer."""
        if self.known is None:
            return None
        known = self.known
        part = known.problem.subset(fitted)
        given = _GivenTransform(part.method, part.poses, part.observations, part.config)
        estimate = fit(given, Estimate(X, known.estimate.target), known.noise)
        points = measured_points(self.samples, known.problem)
        return points.select(np.isin(points.station, measured)).residuals(known.problem, estimate)


class _GivenTransform(Problem):
    """A problem of which only the target is unknown."""

    @property
    def columns(self) -> NDArray[np.intp]:
        return super().columns[6:]


@dataclass(frozen=True, eq=False)
class Measurements:
    """What was read from files, as far as the target's own method believes it."""

    method: FileMethod[Any]
    data: Any
    config: Config

    @property
    def T_sensor_plane(self) -> Array:
        """Return the same, identity where the values are not of profiles (4, 4)."""
        return plane_axes(self.method, self.config)

    @property
    def field(self) -> Array:
        """Return the points (k, 3) over which errors are reported."""
        return self.method.field(self.data)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.method.samples(self.data))

    def subset(self, samples: NDArray[np.intp]) -> Measurements:
        """Return a part of the samples (ascending indices)."""
        return replace(self, data=self.method.subset(self.data, samples))

    def residuals(self, X: Array, fitted: NDArray[np.intp], measured: NDArray[np.intp]
                  ) -> Array | None:
        """Return the residuals of some samples with X, the target fitted to others."""
        return self.method.residuals(self.data, X, fitted, measured, self.config)
