# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A plane: one straight piece of each profile lies on it; its border is not used.

The smallest target, and the example for a new one: what it must state is listed in
profile_target.py. If several surfaces are visible, each station uses the one that fits the
plane, so that all stations use the same surface.

Frame of the target: any point of the plane as origin, z its normal, towards the sensor.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from handeye_ros.data import Array
from handeye_ros.estimation.problem import Estimate, Problem
from handeye_ros.estimation.search import shortlisted
from handeye_ros.estimation.target import target_pose
from handeye_ros.profiles.faces import plane_features
from handeye_ros.targets.profile_target import ProfileTarget
from handeye_ros.targets.starts import (
    best_fitting_first,
    linear_solutions,
    lines_of_parts,
    TRIED_DIRECTIONS,
    with_few_stations,
    with_one_candidate,
)
import numpy as np

PLANE_SOLUTIONS = 10  # that are tried, of those over a grid of directions
SAME_ANGLE = 0.05  # rad: angles to the plane that differ by less are the same


def problems_with_one_surface(problem: Problem) -> list[Problem]:
    """Return problems with one surface per station: its nearest, its longest, or its farthest."""
    surface = PLANE.candidates(problem.observations)
    x, z, slope = lines_of_parts(problem.observations, surface)
    # at the middle of the first surface, the longest: a nearer one lies above its extended line
    depth = problem.config.profile.range_sign * (z - slope[:, :1] * x)
    by_length = np.where(np.isnan(depth), np.nan, np.arange(depth.shape[1]))
    return with_one_candidate(problem, surface, (depth, by_length, -depth))


class Plane(ProfileTarget):
    """A plane: one straight piece of each profile lies on it; its border is not used."""

    name = 'plane'
    kinds = ('face',)
    several_in_view = True
    parameter_names, pose_axes = ('z', 'rx', 'ry'), (2, 3, 4)
    normals = np.array([[0.0, 0.0, 1.0]])
    extract = staticmethod(plane_features)
    lost_with_one_axis = (
        'the position along it is free, and if it is the normal of the plane (yaw only) '
        'all of the position and part of the rotation')

    def starts(self, problem: Problem, rng: np.random.Generator) -> Iterator[Estimate]:
        """Yield starts, best first; of few stations, which fit in many wrong ways, then all."""
        few = with_few_stations(replace(problem, target=PLANE), rng)
        factors = (1, TRIED_DIRECTIONS // PLANE_SOLUTIONS) if problem.needs_more_starts else (1,)
        return best_fitting_first(few, (
            [start for choice in problems_with_one_surface(few) for start in shortlisted(
                choice, linear_solutions(
                    choice, [1, 2, 0], slice(2, 3), factor * PLANE_SOLUTIONS), factor)]
            for factor in factors))

    def alike_views_in_words(self, problem: Problem, estimate: Estimate) -> str:
        """Return in words that all samples see the plane at one angle, '' if they do not."""
        range_axes = problem.poses[:, :3, :3] @ estimate.X[:3, 2]
        normal = estimate.T_base_target[:3, 2]
        angles = np.arccos(np.clip(np.abs(range_axes @ normal), 0.0, 1.0))
        if np.ptp(angles) > SAME_ANGLE:
            return ''
        mean = np.degrees(angles.mean())
        return (f'all samples see the plane at one angle ({mean:.0f} degrees between its normal '
                'and the range axis), so that a shift of the sensor along the range cannot be '
                'told from one of the plane: take samples square to the plane too, and at other '
                'angles')

    def describe(self, state: Array, std: Array) -> dict[str, Any]:
        """Return the plane's normal and distance from the base."""
        T = target_pose(state)
        return {'normal': T[:3, 2].tolist(), 'distance': float(T[:3, 2] @ T[:3, 3])}


PLANE = Plane()
