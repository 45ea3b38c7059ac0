"""Circles through points: fitted, and searched for among points of anything else."""
from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
import math

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv

SPANS = np.array([2.5, 4, 8, 16, 32])  # a hypothesis spans one of these parts of the profile
HYPOTHESES = 72  # per span
KEPT_TRIPLES = 1000  # sizes of profiles whose triples of points are remembered
SEARCH_POINTS = 256  # points that vote
FIRST_VOTERS = 64  # points that vote first, and
BEST_HYPOTHESES = 40  # how many hypotheses the others vote on
TRIES = 5  # circles tried, in the order of their votes
FEWEST_VOTES = 5
LEAST_SAGITTA = 4.0  # of the points on a circle, in tolerances: less is as well a line
TINY = 1e-12
SMALLEST = float(np.finfo(float).tiny)
CONVERGED = 1e-10  # a step of a fit, as a share of the radius


def fit_circle(points: Array, steps: int = 4) -> Array:
    """
    Return the circle (x, z, r) with the least squared radial distances to (n, 2) points.

    steps: of Gauss-Newton from the algebraic fit (Kasa 1976), which is biased for short arcs.
    """
    n = len(points)
    mean_x, mean_z = (float(np.add.reduce(points[:, i])) / n for i in range(2))
    x, z = points[:, 0] - mean_x, points[:, 1] - mean_z  # rows of their own are read faster
    q = x * x + z * z
    xz = 2 * (x @ z)
    centre = _solved(np.array([[2 * (x @ x), xz], [xz, 2 * (z @ z)]]), np.array([x @ q, z @ q]))
    circle = np.append(centre, math.sqrt(float(np.add.reduce(q)) / n + centre @ centre))
    J = np.ones((3, n))
    for _ in range(steps):
        dx, dz = x - circle[0], z - circle[1]
        distance = np.sqrt(dx * dx + dz * dz)
        away = np.maximum(distance, TINY)  # equal points have their centre in them
        np.divide(dx, away, out=J[0])
        np.divide(dz, away, out=J[1])
        step = _solved(J @ J.T, J @ (distance - circle[2]))
        circle += step
        if np.abs(step).max() < CONVERGED * circle[2]:
            break
    return np.asarray(circle + [mean_x, mean_z, 0.0])


def _solved(A: Array, b: Array) -> Array:
    """Return the solution of normal equations, of nearly least norm when they say too little."""
    A.flat[::len(b) + 1] += TINY * A.trace() + SMALLEST
    return np.asarray(dgesv(A, b)[2])


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
        best = int(votes.argmax())
        if votes[best] < FEWEST_VOTES:
            return
        yield np.asarray(circles[best])
        on = on & ~on[best]


def _on_circle(circles: Array, points: Array, tolerance: float) -> NDArray[np.bool_]:
    """Return (k, n) which points are near which circles."""
    # d - r < t and d - r > -t are together |d^2 - r^2 - t^2| < 2 r t, which is a product of
    # matrices; of a circle smaller than t every point inside is near
    x, z, r = circles.T
    of_circles = np.stack([-x / r, -z / r, 0.5 / r,
                           (x * x + z * z - r * r - tolerance ** 2) / (2 * r)], axis=1)
    of_points = np.ones((4, len(points)))
    of_points[0], of_points[1] = points[:, 0], points[:, 1]
    of_points[2] = of_points[0] ** 2 + of_points[1] ** 2
    away = of_circles @ of_points
    tiny = np.flatnonzero(r < tolerance)
    if len(tiny):
        away[tiny] = np.maximum(away[tiny], 0.0)
    return np.asarray(np.abs(away, out=away) < tolerance)


def _votes(on: NDArray[np.bool_], circles: Array, points: Array, tolerance: float
           ) -> NDArray[np.intp]:
    """Return how many points are on each circle, 0 where they are as well on a line."""
    sums = np.ones((4, len(points)))
    sums[0], sums[1] = points[:, 0], points[:, 1]
    sums[2] = sums[0] ** 2 + sums[1] ** 2
    x, z, squares, votes = (on.astype(float) @ sums.T).T
    count = np.maximum(votes, 1.0)
    # evenly spread points of a chord have this variance
    variance = (squares - (x * x + z * z) / count) / count
    sagitta = 12 * np.maximum(variance, 0.0) / (8 * circles[:, 2])
    return np.where(sagitta > LEAST_SAGITTA * tolerance, votes, 0.0).astype(np.intp)


def _hypotheses(points: Array) -> Array:
    """Return circles (k, 3) through three points each, spread over the profile."""
    a, b, c = points[_triples(len(points))]
    found = _through(a, b, c)
    return np.asarray(found[np.isfinite(found).all(axis=1)])


@lru_cache(KEPT_TRIPLES)
def _triples(size: int) -> NDArray[np.intp]:
    """Return (3, k) rows of three out of so many points."""
    span = np.maximum((size / SPANS / 2).astype(int), 1)[:, None]
    last = size - 1 - 2 * span
    first = np.maximum(np.arange(HYPOTHESES) * last // (HYPOTHESES - 1), 0)
    rows = (first + np.arange(3)[:, None, None] * span).reshape(3, -1)
    return np.asarray(np.minimum(rows, size - 1))


def _through(a: Array, b: Array, c: Array) -> Array:
    """Return the circles (k, 3) through three (k, 2) points; not finite for collinear ones."""
    u, v = b - a, c - a
    cross = 2 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    uu, vv = (u ** 2).sum(axis=1), (v ** 2).sum(axis=1)
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        centre = np.column_stack([v[:, 1] * uu - u[:, 1] * vv, u[:, 0] * vv - v[:, 0] * uu])
        centre = centre / cross[:, None]
        return np.column_stack([a + centre, np.linalg.norm(centre, axis=1)])
