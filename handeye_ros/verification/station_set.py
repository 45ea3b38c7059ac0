# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The poses and points of a verification, and whether they are enough.

A station is a pose with points. Stations that share one error of the robot are a group: a stop, a
profile of a sweep, or, of a routine in passes, all poses of a pass.
"""
from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from handeye_ros.data import Indices, Reject
from handeye_ros.errors import DataError
from handeye_ros.estimation.problem import Observations, Problem
from handeye_ros.words import count_of
import numpy as np
from numpy.typing import NDArray

MIN_STATIONS = 4  # of a recording


@dataclass(frozen=True, eq=False)
class StationSet:
    """
    The poses and points at which some recordings show an artefact.

    problem: the n poses of the sensor's mount in the frame of the artefact, and the m points
    stamps: (n,) the time of each pose in nanoseconds
    counts: the number of poses of each recording, in order
    group_of_pose: (n,) the number of the group of poses that share one error of the robot
    surface_note: the choice between several surfaces in sight, in words
    """

    problem: Problem
    stamps: NDArray[np.int64]
    counts: tuple[int, ...]
    group_of_pose: Indices
    surface_note: str = ''

    @property
    def observations(self) -> Observations:
        """Return the points, as observations of the problem."""
        return self.problem.observations

    @property
    def recording_of_pose(self) -> Indices:
        """Return the recording (n,) of each pose."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    @property
    def group_of_point(self) -> Indices:
        """Return the group (m,) of each point."""
        return self.group_of_pose[self.observations.station]

    @property
    def recording_of_point(self) -> Indices:
        """Return the recording (m,) of each point."""
        return self.recording_of_pose[self.observations.station]

    def with_observations(self, observations: Observations) -> StationSet:
        """Return the stations with other points."""
        return replace(self, problem=replace(self.problem, observations=observations))

    def of_groups(self, groups: Indices) -> StationSet:
        """Return the points of some groups; raises DataError where a recording has too few."""
        chosen = np.isin(self.group_of_point, groups)
        stations = self.with_observations(self.observations.select(chosen))
        stations.require_enough()
        return stations

    def require_enough(self, rejects: Sequence[Reject] = ()) -> None:
        """Raise DataError where a recording has too few usable poses; see require_stations."""
        recording = self.recording_of_pose[np.unique(self.observations.station)]
        require_stations(np.bincount(recording, minlength=len(self.counts)).tolist(), rejects)


def stop_number(stamp: int, stamps: Iterable[int]) -> int:
    """Return the number, from 1, of a stop among those of its recording, by their stamps."""
    return bisect_right(sorted(stamps), stamp)


def require_stations(usable: Sequence[int], rejects: Sequence[Reject] = ()) -> None:
    """
    Raise DataError where a recording has fewer than MIN_STATIONS usable stations.

    usable: the number of usable stations of each recording; rejects: the stops without a sample.
    """
    least = min(usable)
    if least < MIN_STATIONS:
        where = f' of recording {usable.index(least) + 1}' if len(usable) > 1 else ''
        raise DataError(
            f'{count_of(least, "usable station")}{where}, fewer than {MIN_STATIONS}'
            f'{f" (of the others: {rejects[0].reason})" if rejects else ""}: measure more, with '
            'the sensor turned differently at each')
