# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether some stops took the face of a clamp, a second plate or the table for that of the plate.

Such ends agree among themselves, so that no consensus of edges stands out. But read for straight
pieces only, the stops agree on one plane, which tells where the sensor is, and so at which heights
their faces lie. The plane may be that of the table: the target is at the height whose stops agree
on it as it is set. The others are named, and left out where these carry an answer (pipeline.py).
So are faces that end where the sensor is blind, as behind dirt on its window.
"""
from __future__ import annotations

from collections.abc import Iterable

from handeye_ros.checks.hypotheses import fit_of_samples
from handeye_ros.checks.settings import MOST_PROFILES, thinned, with_settings
from handeye_ros.config import Config
from handeye_ros.data import Array, EdgePoint, FaceLine, Reject, Sample
from handeye_ros.errors import DataError
from handeye_ros.frames import mount_poses
from handeye_ros.profiles.edges import GAP_COLUMNS
from handeye_ros.sampling.edge_shapes import with_common_shape
from handeye_ros.sampling.features import result_of
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import decoded, Stop
from handeye_ros.se3 import inverse
from handeye_ros.targets import target_for
import numpy as np
from numpy.typing import NDArray

SMALLEST_DISTANCE = 1e-3  # m: faces that are farther apart are several surfaces
LARGEST_INCLINATION = 0.05  # rad: what is more inclined is no surface of a clamp or plate
FEWEST_STOPS = 2  # that show both surfaces: of a target that moved, each stop shows one
ADVICE = ('take samples where the laser crosses the target alone; if it does, check '
          'profile.range_sign and profile.axes')


class NotOfTargetError(DataError):
    """
    Some stops show the edge of another surface, or only the end of what the sensor sees.

    stamps: of their samples; why: what they show, in words.
    """

    def __init__(self, stops: Iterable[Stop], why: str, advice: str = ADVICE) -> None:
        """Build the sentence from stops, what they show and what to do, in words."""
        stops = list(stops)
        self.stamps, self.why = {stop.result.stamp for stop in stops}, why
        shown = f'the {_numbers(stops)} show {why}'
        self.warning = f'{shown}: they are left out'
        super().__init__(f'{shown}: {advice}', reason='surface')


def require_seen_edges(session: Session, config: Config) -> None:
    """Raise NotOfTargetError where ends of faces lie at columns that return nothing anywhere."""
    stops = [stop for stop in session.stops if not stop.final_reason
             and not session.excludes(stop)]
    read = [decoded(thinned(stop, config).profiles, config) for stop in stops]
    if (sum(map(bool, read)) < target_for(config).min_samples  # of few, a column may see nothing
            or len({len(profile.points) for profiles in read for profile in profiles}) != 1):
        return
    points = np.array([profile.points for profiles in read for profile in profiles])
    returned = np.isfinite(points).all(axis=2)
    live = np.flatnonzero(returned.any(axis=0))
    gaps = np.flatnonzero(np.diff(live) > GAP_COLUMNS)
    sides = live[[gaps, gaps + 1]]
    # some stops see across it: else nothing was there, as between plates in the air
    across = returned[:, sides].all(axis=1).sum(axis=0) >= FEWEST_STOPS * MOST_PROFILES
    brinks = sides[:, across]

    def at_a_brink(x: float, line: Array) -> bool:
        column = np.nan_to_num(np.abs(line - x), nan=np.inf).argmin()
        return bool(np.any(np.abs(brinks - column) <= GAP_COLUMNS))

    ending = [stop for stop, profiles in zip(stops, read, strict=True) if stop.sample and profiles
              and any(at_a_brink(edge.point[0], profiles[0].points[:, 0])
                      for edge in stop.sample.features if isinstance(edge, EdgePoint))]
    if ending:
        raise NotOfTargetError(
            ending, 'the end of a face where the sensor returns nothing at any stop, as through '
            'a dirty window', 'clean it, or cross the edges elsewhere in the view')


def require_one_surface(session: Session, config: Config, refusal: DataError) -> None:
    """
    Raise DataError (surface) where stops agree on a plane, but show edges of other surfaces.

    refusal: of the answer; where it says that samples contradict each other, some show something
    else even if no part of them agrees on the target.
    """
    if not target_for(config).essential:
        return
    stops = np.array([s for s in session.stops if s.sample and not session.excludes(s)])
    height, seen, agreeing = _heights_over_plane(stops, config)
    levels, several = _levels(height), False
    for level, at_level in levels:
        shows_level = np.array([bool(np.any(_is_near(faces, level))) for faces in seen])
        if (shows_level & ~at_level).sum() < FEWEST_STOPS:
            continue  # only those that show both tell that there are two
        several |= bool(at_level.sum() >= FEWEST_STOPS)
        above = height[~at_level] - level
        # only wrong axes or a wrong sign make the ground beneath a face
        if np.nanmedian(above) > 0 and _agree_on_target(stops[at_level], config):
            raise NotOfTargetError(stops[~at_level], _told(above))
    if several and refusal.reason in ('misfit', 'edges'):
        told = '; '.join(f'{(level - np.nanmin(height)) * 1e3:.1f} mm: {_numbers(stops[at_level])}'
                         for level, at_level in levels)
        why = f'they show edges at several heights ({told}), as of a clamp or a second plate'
    elif agreeing and refusal.reason == 'misfit':
        why = ('the ends of their faces lie on another object, such as a clamp or a second plate, '
               'the target moved in its plane or is not as target.type and target.size state, '
               'or poses or clocks are wrong along this plane')
    else:
        return
    raise DataError(
        f'{agreeing} of {len(stops)} stops agree on one plane, but not on the edges of the '
        f'target: {why}: {ADVICE}', reason='surface')


def _heights_over_plane(stops: NDArray[np.object_], config: Config
                        ) -> tuple[Array, list[Array], int]:
    """
    Return the heights (m) of faces over the plane on which most stops agree.

    They are of the face at the edge of each stop (n,), and of all faces that each shows; then the
    number of stops that agree. Without such a plane there are no heights, and none agrees.
    """
    as_plane = with_settings(config, {'target.type': 'plane'})
    planes = [result_of(thinned(stop, config), as_plane) for stop in stops]
    fit = fit_of_samples([plane for plane in planes if isinstance(plane, Sample)],
                                 as_plane, [plane.stamp for plane in planes], all_starts=True)
    if not fit.believable or not fit.within_noise:
        return np.full(len(stops), np.nan), [], 0
    estimate = fit.parts[0].estimate
    poses = mount_poses(np.array([stop.sample.T_base_flange for stop in stops]), config)
    T_plane_sensor = inverse(estimate.state.reshape(4, 4)) @ poses @ estimate.X
    height = np.array([_heights(stop.sample, T)[0]
                       for stop, T in zip(stops, T_plane_sensor, strict=True)])
    seen = [_heights(plane, T) for plane, T in zip(planes, T_plane_sensor, strict=True)]
    return height, seen, len(fit.left_out_squares)


def _agree_on_target(stops: NDArray[np.object_], config: Config) -> bool:
    """Return whether stops, however few, agree on the target as it is set."""
    samples = with_common_shape([stop.sample for stop in stops])
    return fit_of_samples(samples, config, [sample.stamp for sample in samples],
                                  all_starts=True).agrees


def _told(heights: Array) -> str:
    """Return in words what has edges at heights (m) over the target, NaN if not parallel."""
    lowest_highest = np.nanquantile(heights * 1e3, (0, 1))
    told = ' to '.join(dict.fromkeys(f'{height:.1f}' for height in lowest_highest))
    inclined = ' or inclined' if np.isnan(heights).any() else ''
    return (f'the edge of another surface, {told} mm above that of the others{inclined}, such as '
            'a clamp or a second plate')


def _levels(height: Array) -> list[tuple[float, NDArray[np.bool_]]]:
    """Return heights (m) that differ, and which of `height` (n,) are near each; most first."""
    near = _is_near(height[:, None], height)
    levels: list[tuple[float, NDArray[np.bool_]]] = []
    for k in np.argsort(-near.sum(axis=1), kind='stable'):
        if near[k].any() and not any(at_level[k] for _, at_level in levels):
            levels.append((height[k], near[k]))
    return levels


def _is_near(heights: Array, level: Array | float) -> NDArray[np.bool_]:
    return np.asarray(np.abs(heights - level) < SMALLEST_DISTANCE)


def _numbers(stops: Iterable[Stop]) -> str:
    return 'stops ' + ', '.join(str(stop.number) for stop in stops)


def _heights(result: Sample | Reject, T_plane_sensor: Array) -> Array:
    """Return the heights (m) of faces over a plane, towards the sensor; NaN if not parallel."""
    by_x, _, by_z, offset = T_plane_sensor[2] * np.sign(T_plane_sensor[2, 3])
    return np.array([
        by_x * face.centre[0] + by_z * face.centre[1] + offset
        if abs(by_x * face.direction[0] + by_z * face.direction[1]) < LARGEST_INCLINATION
        else np.nan for face in getattr(result, 'features', ()) if isinstance(face, FaceLine)])
