# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Park and Martin 1994: robot sensor calibration, solving AX = XB on the Euclidean group.

IEEE Transactions on Robotics and Automation 10(5), 717-721. The vectors of the turns of A and B
give the rotation of X by least squares, then the translation follows by linear least squares.
"""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import require_count, SingularError
import numpy as np

MIN_SINGULAR = 1e-3
"""Two turns have one axis when the second singular value of their vectors is below (radians)."""


def solve_motions(A: Array, B: Array) -> Array:
    """
    Return X (4, 4) of A X = X B, two or more motions (n, 4, 4) about different axes.

    Raises TooFewError, SingularError.
    """
    require_count('A X = X B', 2, 'motions', len(A))
    a, b = se3.log_rotation(A[:, :3, :3]), se3.log_rotation(B[:, :3, :3])
    if np.linalg.svd(a, compute_uv=False)[1] < MIN_SINGULAR:
        raise SingularError('A X = X B', 'all motions turn about one axis only; add another one')
    R = se3.nearest_rotation(a.T @ b)
    M = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    shift = (B[:, :3, 3] @ R.T - A[:, :3, 3]).ravel()
    return se3.transform(R, np.asarray(np.linalg.lstsq(M, shift, rcond=None)[0]))
