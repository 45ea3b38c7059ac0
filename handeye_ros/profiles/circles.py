"""Fits circles to points, and searches for circles among clutter."""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
import math

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv

SPANS = np.array([2.5, 4, 8, 16, 32])  # profile length over the length that a hypothesis spans
HYPOTHESES = 72  # per span
KEPT_TRIPLES = 1000  # profile sizes whose triples are cached
SEARCH_POINTS = 256  # points that vote
FIRST_VOTERS = 64  # points that vote first
BEST_HYPOTHESES = 40  # hypotheses on which the other points vote
TRIES = 5  # circles tried, in the order of their votes
FEWEST_VOTES = 5
LEAST_SAGITTA = 4.0  # smallest sagitta of points on a circle, in tolerances: less is a line
TINY = 1e-12
SMALLEST = float(np.finfo(float).tiny)
CONVERGED = 1e-6  # step of a converged fit, as a share of the radius
STEEP = 0.5  # an arc that ends at a larger angle of incidence (rad) ends at its rim
RIM_WIDTH = 0.24  # angle of the arc before its rim that is not used (rad)
RIM_COSINE = 0.5  # smallest cosine of the incidence of a usable point: the rim is bad
FEWEST_FITTED = 5  # fewest points for another fit of a circle
WIDTHS = (3.0, 2.0, 1.0, 1.0)  # of successive fits from a guessed circle, in tolerances
REFIT_WIDTHS = (2.0, 1.0)  # the same from a fitted circle, also of another profile


def fit_circle(points: Array, steps: int = 4) -> Array:
    """
    Return the circle (x, z, r) with the least squared radial distances to (n, 2) points.

    steps: of Gauss-Newton from the algebraic fit (Kasa 1976), which is biased for short arcs.
    """
    n, (x, z) = len(points), points.T
    mean_x, mean_z = float(np.add.reduce(x)) / n, float(np.add.reduce(z)) / n
    x, z = x - mean_x, z - mean_z
    q = x * x + z * z
    xz = 2 * (x @ z)
    x_c, z_c = _solved(np.array([[2 * (x @ x), xz], [xz, 2 * (z @ z)]]),
                       np.array([x @ q, z @ q]))
    r = math.sqrt(float(np.add.reduce(q)) / n + x_c * x_c + z_c * z_c)
    J = np.ones((3, n))
    for _ in range(steps):
        dx, dz = x - x_c, z - z_c
        distance = np.sqrt(dx * dx + dz * dz)
        away = np.maximum(distance, TINY)  # a point may equal the centre
        np.divide(dx, away, out=J[0])
        np.divide(dz, away, out=J[1])
        by_x, by_z, by_r = _solved(J @ J.T, J @ (distance - r))
        x_c, z_c, r = x_c + by_x, z_c + by_z, r + by_r
        if max(abs(by_x), abs(by_z), abs(by_r)) < CONVERGED * r:
            break
    return np.array([x_c + mean_x, z_c + mean_z, r])


def _solved(A: Array, b: Array) -> list[float]:
    """Return the solution of normal equations, near the minimum norm if they are singular."""
    diagonal = A.ravel()[::len(b) + 1]
    diagonal += TINY * float(np.add.reduce(diagonal)) + SMALLEST
    solution: list[float] = dgesv(A, b)[2].tolist()
    return solution


def candidates(points: Array, smallest: float, largest: float, tolerance: float
               ) -> Iterator[Array]:
    """
    Yield circles (x, z, r) through many of the points (n, 2), the most points first.

    smallest, largest: of the radius (m). Points of a circle do not vote for later ones.
    """
    circles = _hypotheses(points)
    r = circles[:, 2]
    circles = circles.take(np.flatnonzero((r > smallest) & (r < largest)), axis=0)
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
    """Return (n, k) which points are near which circles."""
    # |d - r| < t is the same as |d^2 - r^2 - t^2| < 2 r t, which is a product of matrices; for r <
    # t every point inside the circle is near
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
    """Return the number of points on each circle, 0 where a line fits them as well."""
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
    """Return circles (k, 3) through three points each, distributed over the profile."""
    a, b, c = points.take(_triples(len(points)), axis=0)
    found = _through(a, b, c)
    # a radius is finite where the centre is
    return found.take(np.flatnonzero(np.isfinite(found[:, 2])), axis=0)


@lru_cache(KEPT_TRIPLES)
def _triples(size: int) -> NDArray[np.intp]:
    """Return (3, k) rows of triples out of a number of points."""
    span = np.maximum((size / SPANS / 2).astype(int), 1)[:, None]
    last = size - 1 - 2 * span
    first = np.maximum(np.arange(HYPOTHESES) * last // (HYPOTHESES - 1), 0)
    rows = (first + np.arange(3)[:, None, None] * span).reshape(3, -1)
    return np.asarray(np.minimum(rows, size - 1))


def _through(a: Array, b: Array, c: Array) -> Array:
    """Return the circles (k, 3) through three (k, 2) points; not finite for collinear ones."""
    (ux, uz), (vx, vz) = (b - a).T.copy(), (c - a).T.copy()
    cross = 2 * (ux * vz - uz * vx)
    uu, vv = ux * ux + uz * uz, vx * vx + vz * vz
    circles = np.empty((len(a), 3))
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        x, z = (vz * uu - uz * vv) / cross, (ux * vv - vx * uu) / cross
        circles[:, 0], circles[:, 1] = a[:, 0] + x, a[:, 1] + z
        circles[:, 2] = np.sqrt(x * x + z * z)
    return circles


def arc_points(points: Array, circle: Array, tolerance: float,
               widths: Sequence[float] = WIDTHS) -> NDArray[np.bool_]:
    """
    Return which points (n, 2) are on a circle refitted to them, without its rims.

    widths: of successive fits, in tolerances: nearer points are used for the next circle.
    """
    used = on = np.zeros(len(points), dtype=bool)
    x, z = points.T.copy()
    for width in widths:
        rows = used.nonzero()[0]
        if len(rows) >= FEWEST_FITTED:
            circle = fit_circle(points.take(rows, axis=0), steps=1)
        along, away = x - circle[0], z - circle[1]
        distance = np.sqrt(along * along + away * away)
        on = np.abs(distance - circle[2]) < width * tolerance
        # the light falls on one side of a ball only
        towards = away if away @ on > 0 else -away
        on &= towards > 0
        used = on & (towards > RIM_COSINE * distance)
        if np.count_nonzero(used) < FEWEST_FITTED:
            break
    return used & ~_rim(points, on, circle)


def _rim(points: Array, on: NDArray[np.bool_], circle: Array) -> NDArray[np.bool_]:
    """
    Return which points are near an end of the arc, at grazing incidence.

    Few returns come from near the rim, and then none. The angle at which they end depends on the
    tilt across the profile, which is unknown; so the end of the arc is used instead.
    """
    if not on.any():
        return on
    along, away = points[:, 0] - circle[0], points[:, 1] - circle[1]
    turn = np.arctan2(along, away if away @ on > 0 else -away)
    first, last = _quantiles(turn[on], (0.005, 0.995))
    left = (turn < first + RIM_WIDTH) & (first < -STEEP)
    return np.asarray(left | ((turn > last - RIM_WIDTH) & (last > STEEP)))


def _quantiles(values: Array, levels: tuple[float, ...]) -> list[float]:
    """Return np.quantile of finite values, faster."""
    ordered = np.sort(values)
    positions = [share * (len(ordered) - 1) for share in levels]
    return [float(ordered[int(p)] + (ordered[min(int(p) + 1, len(ordered) - 1)]
                                     - ordered[int(p)]) * (p - int(p))) for p in positions]
