"""
Time of Chen's objective against N, by brute force over all pairs and by the scatter identity.

Run: python bench/chen_pairs.py
"""
from __future__ import annotations

from collections.abc import Callable
import time

from handeye_ros.data import Array
from handeye_ros.published import chen2023
import numpy as np


def by_loops(p: Array, q: Array) -> float:
    """Return eq. 7 with squares as it is written: four sums over ordered pairs."""
    total = 0.0
    for i in p.tolist():
        for j in p.tolist():
            x, y, z = i[0] - j[0], i[1] - j[1], i[2] - j[2]
            for k in q.tolist():
                for m in q.tolist():
                    total += (x * (k[0] - m[0]) + y * (k[1] - m[1]) + z * (k[2] - m[2])) ** 2
    return total


def by_arrays(p: Array, q: Array) -> float:
    """Return the same, all vectors of each edge in one array and all products in another."""
    v_p, v_q = ((x[:, None] - x).reshape(-1, 3) for x in (p, q))
    return float(np.sum((v_p @ v_q.T) ** 2))


def by_scatter(p: Array, q: Array) -> float:
    """Return the same from the scatter matrices."""
    return 4.0 * chen2023.scatter_sum(p, q)


def seconds(function: Callable[[Array, Array], float], p: Array, q: Array) -> float:
    """Return the least time of one call: repeated for 0.2 s, at least once."""
    best, end = np.inf, time.perf_counter() + 0.2
    while True:
        start = time.perf_counter()
        function(p, q)
        now = time.perf_counter()
        best = min(best, now - start)
        if now > end:
            return float(best)


def main() -> None:
    """Print the table; every way must give the same sum."""
    rng = np.random.default_rng(0)
    print('one value of the objective; N points per edge; microseconds')
    print(f'{"N":>5} {"loops":>12} {"arrays":>12} {"unordered":>12} {"scatter":>9}'
          f' {"loops/scatter":>14} {"arrays/scatter":>15}')
    for n in (5, 9, 20, 35, 50, 70, 200, 2000):
        p, q = rng.normal(size=(2, n, 3)) * 0.05
        reference = by_scatter(p, q)
        times = [float('nan')] * 3
        for k, function in enumerate((by_loops, by_arrays, chen2023.pair_sum)):
            if n <= (50, 70, 70)[k]:
                np.testing.assert_allclose(function(p, q) * (4 if k == 2 else 1), reference)
                times[k] = seconds(function, p, q)
        fast = seconds(by_scatter, p, q)
        print(f'{n:5d} ' + ' '.join(f'{1e6 * t:12.1f}' for t in times)
              + f' {1e6 * fast:9.2f} {times[0] / fast:14.0f} {times[1] / fast:15.0f}')


if __name__ == '__main__':
    main()
