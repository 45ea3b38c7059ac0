# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What the Monte-Carlo benches share.

Trials on some processes; the errors of an answer; tables of several estimators on the same trials.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

from handeye_ros import se3
from handeye_ros.results.truth import field_points
from handeye_ros.simulate import Scenario
from handeye_ros.simulate.sensor import FRAMES
import numpy as np

DRAWS = 4000
QUANTITIES = ('transl.', 'rotation', 'mapped')
J, R = TypeVar('J'), TypeVar('R')


def add_options(parser: argparse.ArgumentParser, seeds: int) -> None:
    """Add the options that say which trials there are, and where they run."""
    parser.add_argument('--seeds', type=int, default=seeds, help='trials of each row')
    parser.add_argument('--first', type=int, default=0, help='the first seed')
    parser.add_argument('--only', default='', help='rows whose name holds this text')
    parser.add_argument('--workers', type=int, default=1,
                        help='how many processes; results do not depend on it')


def seeds_of(arguments: argparse.Namespace) -> range:
    """Return the seeds of each row."""
    return range(arguments.first, arguments.first + arguments.seeds)


def results(function: Callable[[J], R], jobs: Sequence[J], workers: int) -> Iterator[R]:
    """Yield what a function returns of each job, in their order; each draws by its own seed."""
    if workers == 1:
        yield from map(function, jobs)
        return
    with ProcessPoolExecutor(workers) as pool:
        yield from pool.map(function, jobs)


def field_of(scenario: Scenario) -> np.ndarray:
    """Return points (k, 3) of the published frame: the middle of the field, 0.2-0.8 of range."""
    (near, far), width = scenario.sensor.range, scenario.sensor.half_width
    x, depth = 0.95 * width * near, far - near
    points = field_points((-x, x), (near + 0.2 * depth, far - 0.2 * depth))
    return se3.apply(se3.inverse(FRAMES[scenario.frame].T_standard_sensor), points)


def nees(T: np.ndarray, covariance: np.ndarray, T_true: np.ndarray) -> float:
    """Return the squared error of a transform, weighted by its stated covariance."""
    delta = se3.difference(T, T_true)
    return float(delta @ np.linalg.solve(covariance, delta))


def errors(T: np.ndarray, T_true: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return (3,) translation (mm), rotation (degrees) and RMS of the mapped points (mm)."""
    delta = se3.difference(T, T_true)
    off = se3.apply(T, points) - se3.apply(T_true, points)
    return np.array([1e3 * np.linalg.norm(delta[:3]), np.degrees(np.linalg.norm(delta[3:])),
                     1e3 * np.sqrt((off ** 2).sum(axis=1).mean())])


def ratios(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Return the median of theirs (n, k) over that of ours: value, low, high of each (3, k)."""
    rng = np.random.default_rng(0)
    drawn = rng.integers(0, len(ours), (DRAWS, len(ours)))
    of_draws = [np.median(theirs[:, k][drawn], axis=1) / np.median(ours[:, k][drawn], axis=1)
                for k in range(ours.shape[1])]
    low, high = np.percentile(of_draws, [2.5, 97.5], axis=1)
    return np.array([np.median(theirs, axis=0) / np.median(ours, axis=0), low, high])


def print_table(title: str, found: Mapping[str, np.ndarray]) -> None:
    """
    Print medians of errors (n, 3) by estimator, ours first; rows of NaN are no answers.

    Of each other its median over ours follows, with the 95 % interval of that ratio (bootstrap
    over the trials, both estimators always drawn together).
    """
    print(title)
    print(f'{"":28} {"transl.":>8} {"rotation":>8} {"mapped":>8} {"worst":>8}   '
          + ' '.join(f'{f"{q} / ours":^18}' for q in QUANTITIES))
    print(f'{"":28} {"mm":>8} {"degrees":>8} {"mm":>8} {"mm":>8}')
    ours = next(iter(found.values()))
    for name, values in found.items():
        answered = np.isfinite(values).all(axis=1)
        if not answered.any():
            print(f'{name:28} no answer')
            continue
        t, r, mapped = np.median(values[answered], axis=0)
        row = f'{name:28} {t:8.4f} {r:8.4f} {mapped:8.4f} {values[answered, 2].max():8.4f}'
        if values is not ours:
            both = answered & np.isfinite(ours).all(axis=1)
            row += '   ' + ' '.join(f'{value:5.2f} ({low:4.2f}-{high:5.2f})' for value, low, high
                                    in ratios(ours[both], values[both]).T)
        missing = np.count_nonzero(~answered)
        print(row + (f'   {missing} without an answer' if missing else ''), flush=True)
    print()
