# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether some stops took the face of a clamp, a second plate or the table for that of the plate.

Such ends agree among themselves, so that no consensus of edges stands out. But the stops show the
face of the plate too, beside the clamp: read for straight pieces only, they agree on one plane.
They are named only where the other stops agree on the target as it is set, and left out where
these carry an answer (pipeline.py).
"""
from __future__ import annotations

from collections.abc import Sequence

from handeye_ros.checks.hypotheses import explanation_of_results
from handeye_ros.checks.settings import thinned, with_settings
from handeye_ros.config import Config
from handeye_ros.data import Array, FaceLine, Sample
from handeye_ros.errors import DataError
from handeye_ros.frames import mount_poses
from handeye_ros.sampling.features import result_of
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Stop
from handeye_ros.se3 import inverse
from handeye_ros.targets import target_for
import numpy as np

SMALLEST_DISTANCE = 1e-3  # m: a face that is farther from the plane is another surface
LARGEST_INCLINATION = 0.05  # rad: what is more inclined is no surface of a clamp or plate
FEWEST_STOPS = 2  # stops on another surface


class OtherSurfaceError(DataError):
    """
    Some stops show the edge of another surface.

    stamps: of their samples; why: what they show, in words.
    """

    def __init__(self, stops: Sequence[Stop], height: float, seen: int, total: int) -> None:
        """Build the sentence; height (m) over the plane that `seen` of all stops show."""
        self.stamps = {stop.result.stamp for stop in stops}
        self.why = (f'the edge of another surface, {height * 1e3:.1f} mm above or below the plane '
                    f'that {seen} of {total} stops show, such as a clamp, a second plate or the '
                    'table')
        numbers = ', '.join(str(stop.number) for stop in stops)
        self.warning = f'the stops {numbers} show {self.why}: they are left out'
        super().__init__(f'the stops {numbers} show {self.why}: take them again where the laser '
                         'crosses the target alone; if it does, check profile.range_sign and '
                         'profile.axes', reason='surface')


def require_one_surface(session: Session, config: Config) -> None:
    """Raise OtherSurfaceError where the faces of some stops lie beside the plane of all."""
    if not target_for(config).essential:
        return
    taken = [stop for stop in session.stops if stop.sample and not session.excludes(stop)]
    as_plane = with_settings(config, {'target.type': 'plane'})
    fit = explanation_of_results([result_of(thinned(stop, config), as_plane) for stop in taken],
                                 as_plane, all_starts=True)
    if not fit.believable:
        return
    estimate, seen = fit.parts[0].estimate, np.isfinite(fit.squares[0])
    T_plane_mount = inverse(estimate.state.reshape(4, 4))
    heights = np.array([
        _height(stop.sample, T_plane_mount @ mount_poses(stop.sample.T_base_flange, config)
                @ estimate.X) for stop in taken if stop.sample])
    beside = np.abs(heights) > SMALLEST_DISTANCE
    if (beside & seen).sum() < FEWEST_STOPS:
        return
    others = explanation_of_results([
        stop.sample for stop, other in zip(taken, ~beside, strict=True) if other],
        config, all_starts=True)
    if others.agrees:  # as few as they may be: it is the plane that tells the surfaces apart
        raise OtherSurfaceError([taken[k] for k in np.flatnonzero(beside)],
                                float(np.median(np.abs(heights[beside]))), int(seen.sum()),
                                len(taken))


def _height(sample: Sample, T_plane_sensor: Array) -> float:
    """Return the height (m) over a plane of the face of a sample; NaN if it is not parallel."""
    face = next((f for f in sample.features if isinstance(f, FaceLine)), None)
    if face is None:
        return np.nan
    by_x, _, by_z, offset = T_plane_sensor[2]
    slope = by_x * face.direction[0] + by_z * face.direction[1]
    height = by_x * face.centre[0] + by_z * face.centre[1] + offset
    return float(height) if abs(slope) < LARGEST_INCLINATION else np.nan
