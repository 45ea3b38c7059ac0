"""
Derivatives by many unknowns that are functions of where the robot is: kept as factors.

An error of the robot has six numbers at each station, and each of these is a sum of some smooth
functions of the poses. A derivative by such an unknown is one of the derivatives by the six
times one of the functions: only the factors are kept and multiplied with.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from handeye_ros.data import Array
import numpy as np
from numpy.typing import NDArray

Rows = Sequence[NDArray[np.intp]]


@dataclass(frozen=True, eq=False)
class Columns:
    """
    Derivatives (m, p) of residuals by p = c + a * k unknowns; the last are axis by axis.

    own: (m, c + a) by the first c, and by a numbers of each station; shared: (n, k) what makes
    each of these of k unknowns; products: (n, k * k) of each two of that. rows: of stations with
    equally many rows, arrays (s, count); station: (m,) of each row.
    """

    own: Array
    shared: Array
    products: Array
    axes: int
    rows: Rows
    station: NDArray[np.intp]

    @property
    def single(self) -> int:
        """Return c, the number of unknowns of which each is by itself."""
        return int(self.own.shape[1]) - self.axes

    @property
    def count(self) -> int:
        """Return p, the number of unknowns."""
        return self.single + self.axes * int(self.shared.shape[1])

    def scaled(self, scales: Array) -> Columns:
        """Return them by unknowns in other units (p,), the same for all functions of an axis."""
        each = np.append(scales[:self.single], scales[self.single::max(self.shared.shape[1], 1)])
        return replace(self, own=self.own * each)

    @cached_property
    def dense(self) -> Array:
        """Return the derivatives (m, p) themselves."""
        return self.dense_rows(slice(None))

    def dense_rows(self, rows: NDArray[np.intp] | slice) -> Array:
        """Return some rows (..., p) of the derivatives."""
        c, own, shared = self.single, self.own[rows], self.shared[self.station[rows]]
        by_axes = own[:, c:, None] * shared[:, None, :]
        return np.concatenate([own[:, :c], by_axes.reshape(len(own), self.count - c)], axis=1)

    def times(self, x: Array) -> Array:
        """Return by how much the residuals (m,) change with the unknowns x (p,)."""
        c = self.single
        at_station = self.shared @ x[c:].reshape(self.axes, self.shared.shape[1]).T
        return np.asarray(self.own[:, :c] @ x[:c]
                          + (self.own[:, c:] * at_station[self.station]).sum(axis=1))

    def change(self, x: Array, rows: NDArray[np.intp]) -> Array:
        """Return what times does (s, count), of s stations' rows."""
        c, (own, functions) = self.single, self.blocks(rows)
        by_axes = functions @ x[c:].reshape(self.axes, self.shared.shape[1]).T
        by_own = np.concatenate([np.broadcast_to(x[:c], (len(rows), c)), by_axes], axis=1)
        return np.asarray((own @ by_own[..., None])[..., 0])

    def gradient_of(self, r: Array, rows: Rows) -> Array:
        """Return the gradient (p,) of half the squares of some rows of residuals r (m,)."""
        c, total = self.single, np.zeros(self.count)
        for some in rows:
            own, functions = self.blocks(some)
            by_station = (r[some][:, None] @ own)[:, 0]
            total[:c] += by_station[:, :c].sum(axis=0)
            total[c:] += (by_station[:, c:].T @ functions).ravel()
        return total

    def gradients(self, r: Array, rows: NDArray[np.intp]) -> Array:
        """Return what gradient_of does (s, p), of each of s stations' residuals r (s, count)."""
        c, (own, functions) = self.single, self.blocks(rows)
        by_station = (r[:, None] @ own)[:, 0]
        by_axes = by_station[:, c:, None] * functions[:, None]
        return np.concatenate([by_station[:, :c], by_axes.reshape(len(r), self.count - c)], axis=1)

    @cached_property
    def gram(self) -> Array:
        """Return the information (p, p) of the unknowns."""
        return self.gram_of(self.rows)

    def gram_of(self, rows: Rows) -> Array:
        """Return the information (p, p) of the unknowns that is in some rows."""
        c, a, k = self.single, self.axes, self.shared.shape[1]
        N = np.zeros((self.count, self.count))
        for some in rows:
            own, functions = self.blocks(some)
            flat = own.reshape(some.size, c + a)[:, :c]
            N[:c, :c] += flat.T @ flat
            by_axes = np.swapaxes(own, 1, 2) @ own[..., c:]
            N[:c, c:] += (by_axes[:, :c].reshape(len(some), c * a).T @ functions).reshape(c, a * k)
            both = by_axes[:, c:].reshape(len(some), a * a).T @ self._at(self.products, some)
            N[c:, c:] += both.reshape(a, a, k, k).swapaxes(1, 2).reshape(a * k, a * k)
        N[c:, :c] = N[:c, c:].T
        return N

    def of(self, stations: NDArray[np.intp]) -> Rows:
        """Return the rows of some stations, by how many each has."""
        return [some[np.isin(self.station[some[:, 0]], stations)] for some in self.rows]

    def blocks(self, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        """Return factors (s, count, c + a) of s stations' rows, and the functions (s, k) there."""
        return self._of_rows(self.own, rows), self._at(self.shared, rows)

    def predicted_covariance(self, covariance: Array, rows: NDArray[np.intp]) -> Array:
        """Return the covariance (s, count, count) of s stations' rows, from that of unknowns."""
        c, a, k = self.single, self.axes, self.shared.shape[1]
        (own, functions), n = self.blocks(rows), len(rows)
        one, by_axis = own[..., :c], own[..., c:]
        cross = (functions @ covariance[:c, c:].reshape(c * a, k).T).reshape(n, c, a)
        both = covariance[c:, c:].reshape(a, k, a, k).swapaxes(1, 2).reshape(a * a, k * k)
        of_axes = (self._at(self.products, rows) @ both.T).reshape(n, a, a)
        # the first by all rows at once: the others are few numbers at each station
        left = (one.reshape(-1, c) @ covariance[:c, :c]).reshape(one.shape)
        mixed = one @ cross @ np.swapaxes(by_axis, 1, 2)
        return np.asarray(left @ np.swapaxes(one, 1, 2) + mixed + np.swapaxes(mixed, 1, 2)
                          + by_axis @ of_axes @ np.swapaxes(by_axis, 1, 2))

    def _of_rows(self, values: Array, rows: NDArray[np.intp]) -> Array:
        if rows.size == len(values):  # all of them, in their order
            return values.reshape(*rows.shape, -1)
        return values[rows]

    def _at(self, values: Array, rows: NDArray[np.intp]) -> Array:
        """Return those of values (n, j) that are of the stations of rows (s, count)."""
        return values if len(rows) == len(values) else values[self.station[rows[:, 0]]]


def products(functions: Array) -> Array:
    """Return what each two of k functions are at n places, multiplied: (n, k * k)."""
    n, k = functions.shape
    return np.asarray((functions[:, :, None] * functions[:, None, :]).reshape(n, k * k))
