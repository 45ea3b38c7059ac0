"""
Observations and the Jacobian, by stations.

A smooth error of the robot has a components, each a sum of k basis functions over the poses. The
derivative of row i by the coefficient of function j in component l is
local[i, l] * basis[station(i), j]; only these factors are stored. With 18 stations a dense matrix
is as fast; with 200 to 1,000 the factors are 3 to 12 times as fast.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from handeye_ros.data import Array
from handeye_ros.estimation.model import Observations
from handeye_ros.estimation.outliers import groups
import numpy as np
from numpy.typing import NDArray

Rows = Sequence[NDArray[np.intp]]


@dataclass(frozen=True, eq=False)
class Stations:
    """
    s stations with c observations each.

    rows: (s, c) row numbers; near: (s, c, c) correlations of the distortion; shared: (s, c, c) 1
    where two observations share the error of one feature; components: (2, s, c, c) 1 where both
    are of the first variance component, or both of the second; mixed: whether some are of the
    second; alone: whether no two share an error.
    """

    rows: NDArray[np.intp]
    near: Array
    shared: Array
    components: Array
    mixed: bool
    alone: bool

    def of(self, values: Array) -> Array:
        """Return values (m, k) of all observations arranged by stations, (s, c, k)."""
        return _of_rows(values, self.rows)

    def every(self, step: int) -> Stations:
        """Return every step-th of the stations."""
        return Stations(self.rows[::step], self.near[::step], self.shared[::step],
                        self.components[:, ::step], self.mixed, self.alone)


def _of_rows(values: Array, rows: NDArray[np.intp]) -> Array:
    """Return values (m, k) of all observations arranged by stations, (s, c, k)."""
    if rows.size == len(values):  # all of them, in their order
        return values.reshape(*rows.shape, -1)
    return values[rows]


def stations_of(observations: Observations) -> tuple[Stations, ...]:
    """Return the stations of observations, grouped by their number of observations."""
    return tuple(_with_rows(observations, rows) for rows in groups(observations.station))


def _with_rows(obs: Observations, rows: NDArray[np.intp]) -> Stations:
    points, source, second = obs.points[rows], obs.source[rows], obs.component[rows] > 0
    apart = points[:, :, None] - points[:, None, :]
    # 0.01 m: correlation length of the sensor's distortion
    near = np.exp(-0.5 * np.einsum('nijk,nijk->nij', apart, apart) / 0.01 ** 2)
    shared = source[:, :, None] == source[:, None, :]
    pairs = np.array([of[:, :, None] & of[:, None, :] for of in (~second, second)], dtype=float)
    return Stations(rows, near, shared.astype(float), pairs, mixed=bool(second.any()),
                    alone=int(shared.sum()) == rows.size)


@dataclass(frozen=True, eq=False)
class FactoredJacobian:
    """
    A Jacobian (m, p) with p = c + a * k columns; the last a * k are ordered by component.

    local: (m, c + a) the first c columns, then the local factors of a components; basis: (n, k)
    functions at the n stations; products: (n, k * k) their pairwise products. rows: row numbers,
    arrays (s, count) of stations with count rows each; station: (m,) of each row.
    """

    local: Array
    basis: Array
    products: Array
    axes: int
    rows: Rows
    station: NDArray[np.intp]

    @property
    def single(self) -> int:
        """Return c, the number of columns that are not factored."""
        return int(self.local.shape[1]) - self.axes

    @property
    def count(self) -> int:
        """Return p, the number of unknowns."""
        return self.single + self.axes * int(self.basis.shape[1])

    def scaled(self, scales: Array) -> FactoredJacobian:
        """Return the Jacobian for unknowns in units (p,), equal within a component."""
        each = np.append(scales[:self.single], scales[self.single::max(self.basis.shape[1], 1)])
        return replace(self, local=self.local * each)

    @cached_property
    def dense(self) -> Array:
        """Return the dense Jacobian (m, p)."""
        c, basis = self.single, self.basis[self.station]
        by_axes = (self.local[:, c:, None] * basis[:, None, :]).reshape(len(basis), -1)
        return np.concatenate([self.local[:, :c], by_axes], axis=1)

    def times(self, x: Array) -> Array:
        """Return the product (m,) of the Jacobian with x (p,)."""
        c = self.single
        at_station = self.basis @ x[c:].reshape(self.axes, self.basis.shape[1]).T
        return np.asarray(self.local[:, :c] @ x[:c]
                          + (self.local[:, c:] * at_station[self.station]).sum(axis=1))

    def change(self, x: Array, rows: NDArray[np.intp]) -> Array:
        """Return the product (s, count) with x (p,), of the rows of s stations."""
        c, (local, functions) = self.single, self.blocks(rows)
        by_axes = functions @ x[c:].reshape(self.axes, self.basis.shape[1]).T
        by_own = np.concatenate([np.broadcast_to(x[:c], (len(rows), c)), by_axes], axis=1)
        return np.asarray((local @ by_own[..., None])[..., 0])

    def gradient_of(self, r: Array, rows: Rows) -> Array:
        """Return J'r (p,) of some rows, with residuals r (m,)."""
        return np.asarray(sum(self.gradients(r[some], some).sum(axis=0) for some in rows))

    def gradients(self, r: Array, rows: NDArray[np.intp]) -> Array:
        """Return J'r (s, p) of each of s stations, with residuals r (s, count)."""
        c, (local, functions) = self.single, self.blocks(rows)
        by_station = (r[:, None] @ local)[:, 0]
        by_axes = by_station[:, c:, None] * functions[:, None]
        return np.concatenate([by_station[:, :c], by_axes.reshape(len(r), self.count - c)], axis=1)

    @cached_property
    def gram(self) -> Array:
        """Return J'J (p, p)."""
        return self.gram_of(self.rows)

    def gram_of(self, rows: Rows) -> Array:
        """Return J'J (p, p) of some rows."""
        c, a, k = self.single, self.axes, self.basis.shape[1]
        N = np.zeros((self.count, self.count))
        for some in rows:
            local, functions = self.blocks(some)
            flat = local.reshape(some.size, c + a)[:, :c]
            N[:c, :c] += flat.T @ flat
            by_axes = np.swapaxes(local, 1, 2) @ local[..., c:]
            N[:c, c:] += (by_axes[:, :c].reshape(len(some), c * a).T @ functions).reshape(c, a * k)
            both = by_axes[:, c:].reshape(len(some), a * a).T @ self._at(self.products, some)
            N[c:, c:] += both.reshape(a, a, k, k).swapaxes(1, 2).reshape(a * k, a * k)
        N[c:, :c] = N[:c, c:].T
        return N

    def of(self, stations: NDArray[np.intp]) -> Rows:
        """Return the rows of some stations, grouped by their number."""
        return [some[np.isin(self.station[some[:, 0]], stations)] for some in self.rows]

    def blocks(self, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        """Return factors (s, count, c + a) of s stations' rows, and the functions (s, k) there."""
        return _of_rows(self.local, rows), self._at(self.basis, rows)

    def predicted_covariance(self, covariance: Array, rows: NDArray[np.intp]) -> Array:
        """Return J C J' (s, count, count) of the rows of s stations, C (p, p) a covariance."""
        c, a, k = self.single, self.axes, self.basis.shape[1]
        (local, functions), n = self.blocks(rows), len(rows)
        one, by_axis = local[..., :c], local[..., c:]
        cross = (functions @ covariance[:c, c:].reshape(c * a, k).T).reshape(n, c, a)
        both = covariance[c:, c:].reshape(a, k, a, k).swapaxes(1, 2).reshape(a * a, k * k)
        of_axes = (self._at(self.products, rows) @ both.T).reshape(n, a, a)
        # one product for all rows; the other terms are small products at each station
        left = (one.reshape(-1, c) @ covariance[:c, :c]).reshape(one.shape)
        mixed = one @ cross @ np.swapaxes(by_axis, 1, 2)
        return np.asarray(left @ np.swapaxes(one, 1, 2) + mixed + np.swapaxes(mixed, 1, 2)
                          + by_axis @ of_axes @ np.swapaxes(by_axis, 1, 2))

    def _at(self, values: Array, rows: NDArray[np.intp]) -> Array:
        """Return the rows (s, j) of values (n, j) for the stations of rows (s, count)."""
        return values if len(rows) == len(values) else values[self.station[rows[:, 0]]]


def products(functions: Array) -> Array:
    """Return the pairwise products of k basis functions (n, k), as (n, k * k)."""
    n, k = functions.shape
    return np.asarray((functions[:, :, None] * functions[:, None, :]).reshape(n, k * k))
