"""Two perpendicular lines through points of a plane, from nothing: the edges of a plate."""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.targets.common import some_stations
import numpy as np

DIRECTIONS = 120  # tried, over a quarter turn
VOTERS = 24  # points that take part in that search


def two_lines(points: Array, rng: np.random.Generator) -> tuple[Array, float]:
    """
    Return corner (2,) and direction (rad) of the best two perpendicular lines through points.

    points: (m, 2). Every direction is tried, and every pair of points to put the lines through;
    a point costs its distance to the nearer line, limited.
    """
    voters = points[some_stations(len(points), VOTERS, rng)]
    angles = np.linspace(0.0, np.pi / 2, DIRECTIONS, endpoint=False)
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    u, v = c * voters[:, 0] + s * voters[:, 1], c * voters[:, 1] - s * voters[:, 0]
    limit = 0.03 * float(np.ptp(voters, axis=0).max() + 1e-9)
    to_q, to_p = (np.minimum(np.abs(w.T[:, :, None] - w), limit).astype(np.float32)
                  for w in (u, v))  # (point, angle, line through)
    total = np.zeros((*u.shape, len(voters)), dtype=np.float32)
    for of_q, of_p in zip(to_q, to_p, strict=True):
        total += np.minimum(of_q[:, :, None], of_p[:, None])
    k, i, j = np.unravel_index(int(np.argmin(total)), total.shape)
    turn = float(angles[k])
    return _fitted(points, turned(turn) @ np.array([u[k, i], v[k, j]]), turn, limit)


def _fitted(points: Array, corner: Array, turn: float, limit: float) -> tuple[Array, float]:
    """Return corner and direction fitted to the points (m, 2) near either line."""
    for reach in (limit, limit / 2, limit / 4):
        x, y = ((points - corner) @ turned(turn)).T
        on_p, on_q = np.abs(y) < np.minimum(np.abs(x), reach), np.abs(x) < np.minimum(
            np.abs(y), reach)
        A = np.concatenate([
            np.column_stack([np.zeros(on_p.sum()), np.ones(on_p.sum()), x[on_p]]),
            np.column_stack([np.ones(on_q.sum()), np.zeros(on_q.sum()), -y[on_q]])])
        step = np.linalg.lstsq(A, np.concatenate([y[on_p], x[on_q]]), rcond=None)[0]
        corner, turn = corner + turned(turn) @ step[:2], turn + float(step[2])
    return corner, turn


def turned(turn: float) -> Array:
    """Return the (2, 2) rotation by an angle."""
    return np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
