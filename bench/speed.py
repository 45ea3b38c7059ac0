#!/usr/bin/env python3
"""
How long a solve takes, guess included, and a whole recording offline.

usage: python bench/speed.py

Prints, for plate and sphere, the median seconds from samples to answer for 18 and for 2000
stations and the ratio of the two, and the wall time of `handeye solve` (import included) on a
simulated 40 s bag of 1280-point profiles at 30 Hz.
"""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import subprocess
import sys
import tempfile
import time

from handeye_ros import config as configs
from handeye_ros import pipeline
from handeye_ros.config import Config
from handeye_ros.simulate import SCENARIOS, simulate_samples
from handeye_ros.simulate.settings import settings
import numpy as np

CONFIG = Path(__file__).parents[1] / 'config' / 'plate.yaml'


def solve_seconds(target: str, stations: int, runs: int) -> float:
    """Return the median time of a solve in seconds."""
    scenario = replace(SCENARIOS[target], stations=(stations // 2, stations // 2))
    samples, _ = simulate_samples(scenario, np.random.default_rng(0))
    config = configs.with_values(Config(), settings(scenario), target)
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        pipeline.solve(samples, (), config, 'laser')
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def bag_seconds(runs: int = 3) -> float:
    """Return the least wall time of the command line on a 40 s bag."""
    with tempfile.TemporaryDirectory() as folder:
        handeye = [sys.executable, '-m', 'handeye_ros']
        bag = f'{folder}/bag'
        subprocess.run([*handeye, 'simulate', 'plate', bag], check=True, capture_output=True)
        times = []
        for _ in range(runs):
            start = time.perf_counter()
            subprocess.run([*handeye, 'solve', bag, '--config', CONFIG, '--out', folder],
                           check=True, capture_output=True)
            times.append(time.perf_counter() - start)
        return min(times)


def main() -> None:
    """Print the figures."""
    for target in ('plate', 'sphere'):
        few, many = solve_seconds(target, 18, 11), solve_seconds(target, 2000, 3)
        print(f'{target:7} 18 stations {1e3 * few:6.1f} ms, 2000 stations {many:6.2f} s, '
              f'ratio {many / few:5.1f}', flush=True)
    print(f'handeye solve, 40 s of 1280 points at 30 Hz: {bag_seconds():.2f} s')


if __name__ == '__main__':
    main()
