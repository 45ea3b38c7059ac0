# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Wu 2017: the best of 210 quadruples, and the seam of its section 4."""
from __future__ import annotations

from math import comb

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import SingularError
from handeye_ros.published import wu2017
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

"""Eq. 18, millimetres."""


def points(seed: int, noise: float = 0.0) -> tuple[Array, Array, Array]:
    """Return T_camera_base and ten points in camera and base (metres)."""
    rng = np.random.default_rng(seed)
    T = se3.transform(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-1, 1, 3))
    base = rng.uniform(-0.15, 0.15, (10, 3)) + [0.6, 0.1, 0.3]
    return T, se3.apply(T, base) + noise * rng.normal(size=(10, 3)), base


def test_all_210_quadruples_and_the_best_of_them() -> None:
    _, camera, base = points(1, 3e-5)
    found = wu2017.solve(camera, base)
    assert len(found.costs) == comb(10, 4) == 210
    assert np.isfinite(found.costs).all()
    assert found.cost == found.costs.min()
    four = list(found.quadruple)
    np.testing.assert_allclose(se3.apply(found.matrix, base)[four], camera[four], atol=1e-9)
    by_eq_4 = (np.vstack([camera[four].T, np.ones(4)])
               @ np.linalg.inv(np.vstack([base[four].T, np.ones(4)])))
    np.testing.assert_allclose(found.matrix, by_eq_4, atol=1e-9)
    by_eq_5 = sum(np.linalg.norm(c - (by_eq_4 @ np.append(w, 1.0))[:3])
                  for c, w in zip(camera, base, strict=True))
    assert found.cost == pytest.approx(by_eq_5)


def test_four_points_in_one_plane_are_left_out() -> None:
    T, _, base = points(2)
    base[:9, 2] = 0.3
    found = wu2017.solve(se3.apply(T, base), base)
    assert np.isinf(found.costs).sum() == comb(9, 4)
    assert 9 in found.quadruple
    assert np.abs(se3.difference(found.T_camera_base, T)).max() < 1e-6
    base[9, 2] = 0.3
    with pytest.raises(SingularError, match='one plane'):
        wu2017.solve(se3.apply(T, base), base)
