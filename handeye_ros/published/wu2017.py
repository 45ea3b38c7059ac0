# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Wu, Wang, Li et al. 2017: four points, eye to hand. Its seams: handeye_ros/scanning/seam.py.

Materials Science and Technology 25(2), 16-21, doi 10.11951/j.issn.1005-0299.20160369. The tip of
a rod is put to ten places; the robot knows them in its base, the scanner sees them. Any four
give T = T_c inv(T_w); the best of the 210 quadruples of ten is taken (eq. 5).

What is wrong in print, and what is done here:

- eq. 5 sums over i what carries the index j: P_ci - T_gj P_wi is meant. The norms are summed,
  not their squares.
- T is no rigid transform when there is noise; the nearest rotation is taken, placed so that the
  mean of all points agrees.
- four points in one plane have no inverse (eq. 3); such quadruples are not used.
- eq. 11 says a0 twice; the second is a1. Its plane z = a0 x + a1 y + a2 (eqs. 10 to 14), whose
  normal is o, cannot stand upright; `handeye seam` takes o from the faces of the seam.
- n and o are measured apart and not square to each other, so eq. 16 is no rotation, and the
  third column printed in eq. 19 is not n x o (eq. 15).
"""
from __future__ import annotations

from itertools import combinations

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import require_count, SingularError
import numpy as np

FLAT_SHARE = 1e-6
"""Four points are in one plane when |T_w| is below this many cubes of their spread."""


def solve(in_camera: Array, in_base: Array) -> Array:
    """
    Return T_base_camera (4, 4), the eye-to-hand calibration, by the best quadruple of the points.

    in_camera, in_base: (n, 3), the same points in both frames (metres), n = 10 in the paper.
    Raises TooFewError, SingularError.
    """
    require_count('Wu 2017', 4, 'points', len(in_base))
    quadruples = np.array(list(combinations(range(len(in_base)), 4)))
    T_w, T_c = (np.insert(p[quadruples], 3, 1.0, axis=2).swapaxes(1, 2)
                for p in (in_base, in_camera))
    spread = np.linalg.norm(in_base[quadruples] - in_base[quadruples].mean(axis=1)[:, None],
                            axis=(1, 2))
    regular = np.abs(np.linalg.det(T_w)) > FLAT_SHARE * spread ** 3
    if not regular.any():
        raise SingularError('Wu 2017', 'all points lie in one plane; move one out of it')
    T_g = T_c[regular] @ np.linalg.inv(T_w[regular])
    costs = np.linalg.norm(se3.apply(T_g, in_base) - in_camera, axis=2).sum(axis=1)
    best = T_g[np.argmin(costs)]
    R, mean = se3.nearest_rotation(best[:3, :3]), in_base.mean(axis=0)
    return se3.inverse(se3.transform(R, best[:3, :3] @ mean + best[:3, 3] - R @ mean))
