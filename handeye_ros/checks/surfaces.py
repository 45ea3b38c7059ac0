# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether some stops show another surface than the target: their number, and what they show.

Where the stops are known, OtherSurfaceError is raised, by which the pipeline leaves them out where
the others carry an answer (pipeline.py); else a plain DataError.

A clamp, a second plate or the table have edges too, which agree among themselves, so that no
consensus of edges stands out. But read for straight pieces only, the stops agree on one plane,
which tells where the sensor is, and so at which heights their faces lie. The plane may be that of
the table: the target is at the height whose stops agree on it as configured.
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence

from handeye_ros.checks.hypotheses import explain_samples, stops_to_explain
from handeye_ros.checks.settings import with_correction, with_few_profiles
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
from numpy.typing import NDArray

MIN_DISTANCE = 1e-3  # m: faces that are farther apart are several surfaces
MAX_INCLINATION = 0.05  # rad: what is more inclined is no surface of a clamp or plate
MIN_STOPS = 2  # that show both surfaces: of a target that moved, each stop shows one
ADVICE = ('take samples where the laser crosses the target alone; if it does, check '
          'profile.range_sign, profile.axes and profile.invalid')


class OtherSurfaceError(DataError):
    """
    Some stops show the edge of another surface.

    stamps: of their samples; why: what they show, in words; warning: where they are not used.
    """

    def __init__(self, stops: Iterable[Stop], why: str) -> None:
        """Build the sentence from stops, and what they show in words."""
        stops = list(stops)
        self.stamps, self.why = {stop.result.stamp for stop in stops}, why
        they_show = f'the {_numbers(stops)} show {why}'
        self.warning = f'{they_show}: they are not used'
        super().__init__(f'{they_show}: {ADVICE}', code='surface')


def require_one_surface(session: Session, config: Config, refusal: DataError) -> None:
    """
    Raise DataError (surface) where stops agree on a plane, but show edges of other surfaces.

    refusal: of the answer; where it says that samples contradict each other, some show something
    else even if no part of them agrees on the target.
    """
    if not target_for(config).edge_kinds:
        return
    stops = np.array([stop for stop in stops_to_explain(session) if stop.sample])
    at_edge, shown, agreeing = _heights_over_plane(stops, config)
    levels, several = _levels(at_edge), False
    for level, is_at_level in levels:
        shows_level = np.array([bool(np.any(_is_near(heights, level))) for heights in shown])
        if (shows_level & ~is_at_level).sum() < MIN_STOPS:
            continue  # only those that show both tell that there are two
        above = at_edge[~is_at_level] - level
        if not np.isfinite(above).any():
            continue
        several |= bool(is_at_level.sum() >= MIN_STOPS)
        # only wrong axes or a wrong sign make the ground beneath a face
        if np.nanmedian(above) > 0 and _agree_on_target(stops[is_at_level], config):
            raise OtherSurfaceError(stops[~is_at_level], _surface_in_words(above))
    heights = [(level - np.nanmin(at_edge), stops[is_at_level]) for level, is_at_level in levels]
    if why := _unnamed_surface(heights if several else [], agreeing, refusal.code):
        raise DataError(
            f'{agreeing} of {len(stops)} stops agree on one plane, but not on the edges of the '
            f'target: {why}: {ADVICE}', code='surface')


def _unnamed_surface(heights: Sequence[tuple[float, NDArray[np.object_]]], agreeing: int,
                     code: str) -> str:
    """
    Return in words what stops may show of which no part agrees on the target, '' if unknown.

    heights: over the lowest edge (m), each with the stops that show an edge there, none if only
    one has several stops; agreeing: how many stops agree on a plane; code: of the refusal.
    """
    if heights and code in ('misfit', 'edges'):
        listed = '; '.join(f'{height * 1e3:.1f} mm: {_numbers(at)}' for height, at in heights)
        return f'they show edges at several heights ({listed}), as of a clamp or a second plate'
    if agreeing and code == 'misfit':
        return ('the ends of their faces lie on another object, such as a clamp or a second '
                'plate, the target moved in its plane or is not as target.type and target.size '
                'state, or poses or clocks are wrong along this plane')
    return ''


def _heights_over_plane(stops: NDArray[np.object_], config: Config
                        ) -> tuple[Array, list[Array], int]:
    """
    Return the heights (m) of faces over the plane on which most stops agree.

    They are of the face at the edge of each stop (n,), and of all faces that each shows; then the
    number of stops that agree. Without such a plane there are no heights, and none agrees.
    """
    as_plane = with_correction(config, {'target.type': 'plane'})
    results = [result_of(with_few_profiles(stop, config), as_plane) for stop in stops]
    fit = explain_samples([result for result in results if isinstance(result, Sample)], as_plane,
                          [result.stamp for result in results], all_starts=True)
    if not fit.believable or not fit.within_noise:
        return np.full(len(stops), np.nan), [], 0
    estimate = fit.solutions[0].estimate
    poses = mount_poses(np.array([stop.sample.T_base_flange for stop in stops]), config)
    T_target_sensor_plane = inverse(estimate.T_base_target) @ poses @ estimate.X
    at_edge = np.array([_face_heights(stop.sample, T)[0]
                        for stop, T in zip(stops, T_target_sensor_plane, strict=True)])
    shown = [_face_heights(result, T) for result, T in zip(
        results, T_target_sensor_plane, strict=True)]
    return at_edge, shown, len(fit.left_out_squares)


def _face_heights(result: Sample | Reject, T_target_sensor_plane: Array) -> Array:
    """Return the heights (m) of faces over a plane, towards the sensor; NaN if not parallel."""
    by_x, _, by_z, offset = T_target_sensor_plane[2] * np.sign(T_target_sensor_plane[2, 3])
    return np.array([
        by_x * face.centre[0] + by_z * face.centre[1] + offset
        if abs(by_x * face.direction[0] + by_z * face.direction[1]) < MAX_INCLINATION
        else np.nan for face in (result.features if isinstance(result, Sample) else ())
        if isinstance(face, FaceLine)])


def _levels(heights: Array) -> list[tuple[float, NDArray[np.bool_]]]:
    """Return levels (m) that differ, and which of the heights (n,) are at each; most first."""
    near = _is_near(heights[:, None], heights)
    levels: list[tuple[float, NDArray[np.bool_]]] = []
    for k in np.argsort(-near.sum(axis=1), kind='stable'):
        if near[k].any() and not any(is_at_level[k] for _, is_at_level in levels):
            levels.append((heights[k], near[k]))
    return levels


def _is_near(heights: Array, level: Array | float) -> NDArray[np.bool_]:
    return np.asarray(np.abs(heights - level) < MIN_DISTANCE)


def _agree_on_target(stops: NDArray[np.object_], config: Config) -> bool:
    """Return whether stops, however few, agree on the target as configured."""
    return explain_samples([stop.sample for stop in stops], config, all_starts=True).agrees


def _surface_in_words(heights: Array) -> str:
    """Return in words what has edges at heights (m) over the target, NaN if not parallel."""
    lowest_highest = np.nanquantile(heights * 1e3, (0, 1))
    span = ' to '.join(dict.fromkeys(f'{height:.1f}' for height in lowest_highest))
    inclined = ' or inclined' if np.isnan(heights).any() else ''
    return (f'the edge of another surface, {span} mm above that of the others{inclined}, such as '
            'a clamp or a second plate')


def _numbers(stops: Iterable[Stop]) -> str:
    return 'stops ' + ', '.join(str(stop.number) for stop in stops)
