#!/usr/bin/env python3
"""
Our estimators beside the published ones, on the same simulated samples.

usage: python bench/compare.py [--plates N] [--spheres N] [--lines N] [--seed S]

Simulates features with known noise (no profiles), which the settings state, and runs what
`handeye compare` runs. A row per estimator: in how many trials it had an answer, and of these
the medians of error (translation, rotation, mapped points over x within +-20 mm, range
160-190 mm; and its worst), residual and time; then its median mapped error over ours.
"""
from __future__ import annotations

import argparse
from collections.abc import Sequence
import math

from handeye_ros import config as configs
from handeye_ros.compare import compare, Row
from handeye_ros.config import Config
from handeye_ros.simulate import SCENARIOS, settings, simulate_samples
import numpy as np


def trial(target: str, seed: int) -> tuple[Row, ...]:
    """Return the rows of one simulated cell."""
    scenario = SCENARIOS[target]
    samples, truth = simulate_samples(scenario, np.random.default_rng(seed))
    values = settings(scenario) | {'noise.distortion': 0.0}  # features are made without
    config = configs.with_values(Config(), values, 'the scenario')
    return compare(samples, (), config, truth.T_flange_sensor, folds=0).rows


def figures(rows: Sequence[Row]) -> np.ndarray:
    """Return errors (mm, degrees, mm), residual (mm) and seconds (n, 5) of answers."""
    return np.array([
        (1e3 * row.errors.translation, math.degrees(row.errors.rotation),
         1e3 * row.errors.mapped_points, 1e3 * row.residual_rms, row.seconds)
        for row in rows if row.errors and row.residual_rms is not None]).reshape(-1, 5)


def main() -> None:
    """Print a table for each target."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--plates', type=int, default=20)
    parser.add_argument('--spheres', type=int, default=50)
    parser.add_argument('--lines', type=int, default=50)
    parser.add_argument('--seed', type=int, default=0)
    arguments = parser.parse_args()
    for target in ('plate', 'sphere', 'line'):
        count = getattr(arguments, f'{target}s')
        trials = [trial(target, arguments.seed + k) for k in range(count)]
        print(f'{target}, {count} trials')
        print(f'{"":28} {"answers":>7} {"transl.":>8} {"rotation":>8} {"mapped":>8} {"worst":>8} '
              f'{"residual":>8} {"time":>8} {"mapped /":>8}')
        print(f'{"":28} {"":7} {"mm":>8} {"degrees":>8} {"mm":>8} {"mm":>8} {"mm":>8} {"s":>8} '
              f'{"ours":>8}')
        ours = None
        for rows in zip(*trials, strict=True):
            values = figures(rows)
            if not len(values):
                print(f'{rows[0].name:28} {0:7}')
                continue
            t, r, mapped, residual, seconds = np.median(values, axis=0)
            ours = ours or mapped
            print(f'{rows[0].name:28} {len(values):7} {t:8.3f} {r:8.4f} {mapped:8.4f} '
                  f'{values[:, 2].max():8.4f} {residual:8.4f} {seconds:8.4f} '
                  f'{mapped / ours:8.2f}', flush=True)
        print()


if __name__ == '__main__':
    main()
