# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether some stops took the face of a clamp, a second plate or the table for that of the plate.

Such ends agree among themselves, so that no consensus of edges stands out. But read for straight
pieces only, the stops agree on one plane, which tells where the sensor is, and so at which heights
their faces lie. The plane may be that of the table: the target is at the height whose stops agree
on it as it is set. The others are named, and left out where these carry an answer (pipeline.py).
"""
from __future__ import annotations

from collections.abc import Sequence

from handeye_ros.checks.hypotheses import explanation_of_results
from handeye_ros.checks.settings import thinned, with_settings
from handeye_ros.config import Config
from handeye_ros.data import Array, FaceLine, Reject, Sample
from handeye_ros.errors import DataError
from handeye_ros.frames import mount_poses
from handeye_ros.sampling.features import result_of
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Stop
from handeye_ros.se3 import inverse
from handeye_ros.targets import target_for
import numpy as np

SMALLEST_DISTANCE = 1e-3  # m: faces that are farther apart are several surfaces
LARGEST_INCLINATION = 0.05  # rad: what is more inclined is no surface of a clamp or plate
FEWEST_STOPS = 2  # that show both surfaces: of a target that moved, each stop shows one
ALONE = 'take samples where the laser crosses the target alone'


class OtherSurfaceError(DataError):
    """
    Some stops show the edge of another surface.

    stamps: of their samples; why: what they show, in words.
    """

    def __init__(self, stops: Sequence[Stop], height: float) -> None:
        """Build the sentence; height (m) over the target."""
        self.stamps = {stop.result.stamp for stop in stops}
        self.why = (f'the edge of another surface, {height * 1e3:.1f} mm above or below that of '
                    'the others, such as a clamp, a second plate or the table')
        self.warning = f'the stops {_numbers(stops)} show {self.why}: they are left out'
        super().__init__(f'the stops {_numbers(stops)} show {self.why}: {ALONE}; if it does, '
                         'check profile.range_sign and profile.axes', reason='surface')


def require_one_surface(session: Session, config: Config, contradicted: bool) -> None:
    """
    Raise DataError where stops agree on a plane, but show edges of other surfaces.

    contradicted: whether the samples contradict each other for no known cause, so that some show
    something else even where no part of them agrees on the target.
    """
    if not target_for(config).essential:
        return
    taken = [stop for stop in session.stops if stop.sample and not session.excludes(stop)]
    samples = [stop.sample for stop in taken if stop.sample]
    as_plane = with_settings(config, {'target.type': 'plane'})
    planes = [result_of(thinned(stop, config), as_plane) for stop in taken]
    fit = explanation_of_results(planes, as_plane, all_starts=True)
    if not fit.believable:
        return
    estimate = fit.parts[0].estimate
    T_plane_mount = inverse(estimate.state.reshape(4, 4))
    T = [T_plane_mount @ mount_poses(sample.T_base_flange, config) @ estimate.X
         for sample in samples]
    seen = [_heights(plane, T_k) for plane, T_k in zip(planes, T, strict=True)]
    height = np.array([_heights(sample, T_k)[0] for sample, T_k in zip(samples, T, strict=True)])
    groups = np.unique(_near(height[:, None], height)[np.isfinite(height)], axis=0)
    groups = groups[np.argsort(-groups.sum(axis=1), kind='stable')]
    for alike in groups:
        middle, others = np.median(height[alike]), np.flatnonzero(~alike)
        both = sum(_near(seen[k], middle).any() for k in others)
        if both >= FEWEST_STOPS and explanation_of_results(
                [samples[k] for k in np.flatnonzero(alike)], config, all_starts=True).agrees:
            # as few as they may be: it is the plane that tells the surfaces apart
            raise OtherSurfaceError([taken[k] for k in others],
                                    float(np.nanmedian(np.abs(height[others] - middle))))
    if contradicted:
        why = ('the ends of their faces lie on another object, such as a clamp or a second plate, '
               'or the target moved in its plane, or is not as target.type and target.size state')
        if (groups.sum(axis=1) >= FEWEST_STOPS).sum() > 1:
            lowest = np.nanmin(height)
            at = '; '.join(f'{(np.median(height[alike]) - lowest) * 1e3:.1f} mm: stops '
                           + _numbers(taken, alike) for alike in groups)
            why = (f'they show edges at several heights ({at}), as of a clamp, a second plate or '
                   'the table')
        raise DataError(f'{fit.fitting} of {len(taken)} stops agree on one plane, so that poses '
                        f'and clocks are right, but they contradict each other where the edges '
                        f'are: {why}; {ALONE}', reason='surface')


def _near(heights: Array, middle: Array | float) -> Array:
    """Return which heights are those of one surface with another."""
    return np.abs(heights - middle) < SMALLEST_DISTANCE


def _numbers(stops: Sequence[Stop], chosen: Array | None = None) -> str:
    return ', '.join(str(stops[k].number) for k in (
        range(len(stops)) if chosen is None else np.flatnonzero(chosen)))


def _heights(result: Sample | Reject, T_plane_sensor: Array) -> Array:
    """Return the heights (m) of faces over a plane, towards the sensor; NaN if not parallel."""
    faces = [] if isinstance(result, Reject) else [
        feature for feature in result.features if isinstance(feature, FaceLine)]
    by_x, _, by_z, offset = T_plane_sensor[2] * np.sign(T_plane_sensor[2, 3])
    return np.array([
        by_x * face.centre[0] + by_z * face.centre[1] + offset
        if abs(by_x * face.direction[0] + by_z * face.direction[1]) < LARGEST_INCLINATION
        else np.nan for face in faces])
