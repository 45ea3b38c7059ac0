"""Circles through points: fitted, and searched for among points of anything else."""
from __future__ import annotations

from collections.abc import Iterator

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray

SPANS = np.array([2.5, 4, 8, 16, 32])  # a hypothesis spans one of these parts of the profile
HYPOTHESES = 72  # per span
SEARCH_POINTS = 256  # points that vote
FIRST_VOTERS = 64  # points that vote first, and
BEST_HYPOTHESES = 40  # how many hypotheses the others vote on
TRIES = 5  # circles tried, in the order of their votes
FEWEST_VOTES = 5
LEAST_SAGITTA = 4.0  # of the points on a circle, in tolerances: less is as well a line
TINY = 1e-12
CONVERGED = 1e-10  # a step of a fit, as a share of the radius


def fit_circle(points: Array, steps: int = 4) -> Array:
    """
    Return the circle (x, z, r) with the least squared radial distances to (n, 2) points.

    steps: of Gauss-Newton from the algebraic fit (Kasa 1976), which is biased for short arcs.
    """
    mean = points.mean(axis=0)
    x, z = (points - mean).T
    q = x * x + z * z
    M = np.array([[x @ x, x @ z], [x @ z, z @ z]])
    centre = _solved(2 * M, np.array([x @ q, z @ q]))
    circle = np.append(centre, np.sqrt(q.mean() + centre @ centre))
    for _ in range(steps):
        dx, dz = x - circle[0], z - circle[1]
        distance = np.sqrt(dx * dx + dz * dz)
        away = np.maximum(distance, TINY)  # equal points have their centre in them
        J = np.stack([dx / away, dz / away, np.ones(len(x))])
        step = _solved(J @ J.T, J @ (distance - circle[2]))
        circle = circle + step
        if np.abs(step).max() < CONVERGED * circle[2]:
            break
    return np.asarray(circle + [*mean, 0.0])


def _solved(A: Array, b: Array) -> Array:
    """Return the solution of normal equations, of nearly least norm when they say too little."""
    ridge = TINY * np.trace(A) + np.finfo(float).tiny
    return np.asarray(np.linalg.solve(A + ridge * np.eye(len(b)), b))


def candidates(points: Array, smallest: float, largest: float, tolerance: float
               ) -> Iterator[Array]:
    """
    Yield circles (x, z, r) on which many of the points (n, 2) lie, the most first.

    smallest, largest: of the radius. The points of a circle have no say for those after it.
    """
    circles = _hypotheses(points)
    circles = circles[(circles[:, 2] > smallest) & (circles[:, 2] < largest)]
    voters = points[::-(-len(points) // SEARCH_POINTS)]
    if not len(circles):
        return
    some = voters[::max(len(voters) // FIRST_VOTERS, 1)]
    first = _votes(_on_circle(circles, some, tolerance), circles, some, tolerance)
    circles = circles[np.argsort(-first, kind='stable')[:BEST_HYPOTHESES]]
    on = _on_circle(circles, voters, tolerance)
    for _ in range(TRIES):
        votes = _votes(on, circles, voters, tolerance)
        best = int(np.argmax(votes))
        if votes[best] < FEWEST_VOTES:
            return
        yield np.asarray(circles[best])
        on = on & ~on[best]


def _on_circle(circles: Array, points: Array, tolerance: float) -> NDArray[np.bool_]:
    """Return (k, n) which points are near which circles."""
    x, z, r = circles.T[:, :, None]
    distance = np.sqrt((points[:, 0] - x) ** 2 + (points[:, 1] - z) ** 2) - r
    return np.asarray(np.abs(distance) < tolerance)


def _votes(on: NDArray[np.bool_], circles: Array, points: Array, tolerance: float
           ) -> NDArray[np.intp]:
    """Return how many points are on each circle, 0 where they are as well on a line."""
    votes = on.sum(axis=1)
    count = np.maximum(votes, 1)
    share = on / count[:, None]
    mean = share @ points
    # evenly spread points of a chord have this variance
    chord_squared = 12 * np.maximum(share @ (points ** 2).sum(axis=1) - (mean ** 2).sum(axis=1), 0)
    sagitta = chord_squared / (8 * circles[:, 2])
    return np.where(sagitta > LEAST_SAGITTA * tolerance, votes, 0)


def _hypotheses(points: Array) -> Array:
    """Return circles (k, 3) through three points each, spread over the profile."""
    span = np.maximum((len(points) / SPANS / 2).astype(int), 1)[:, None]
    last = len(points) - 1 - 2 * span
    first = np.maximum(np.arange(HYPOTHESES) * last // (HYPOTHESES - 1), 0)
    rows = (first + np.arange(3)[:, None, None] * span).reshape(3, -1)
    a, b, c = points[np.minimum(rows, len(points) - 1)]
    found = _through(a, b, c)
    return np.asarray(found[np.isfinite(found).all(axis=1)])


def _through(a: Array, b: Array, c: Array) -> Array:
    """Return the circles (k, 3) through three (k, 2) points; not finite for collinear ones."""
    u, v = b - a, c - a
    cross = 2 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    uu, vv = (u ** 2).sum(axis=1), (v ** 2).sum(axis=1)
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        centre = np.column_stack([v[:, 1] * uu - u[:, 1] * vv, u[:, 0] * vv - v[:, 0] * uu])
        centre = centre / cross[:, None]
        return np.column_stack([a + centre, np.linalg.norm(centre, axis=1)])
