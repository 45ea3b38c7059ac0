#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
How long a profile takes, a solve, guess included, and a whole recording offline.

usage: python bench/speed.py

Prints, for the bags of plate (1280 points) and sphere (640 points), how many profiles a second
of the processor are segmented, as the best of seven rounds, beside the 96 a second of the network
of a published method. Then, for plate and sphere, the median
seconds of the processor from samples to answer for 18 and for 2000 stops and the ratio of the
two, and the wall time of `handeye solve` (import included) on a simulated 40 s bag of 1280-point
profiles at 30 Hz.
"""
from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
import subprocess
import sys
import tempfile
import time

from handeye_ros import config as configs
from handeye_ros import pipeline, targets
from handeye_ros.bags.recording import read_bag
from handeye_ros.config import Config
from handeye_ros.errors import FeatureError
from handeye_ros.simulate import SCENARIOS, settings, simulate_samples
import numpy as np

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / 'config' / 'plate.yaml'
NETWORK = 96  # profiles a second that a published network segments


def solve_seconds(target: str, stops: int, runs: int) -> float:
    """Return the median seconds of the processor that a solve takes."""
    scenario = replace(SCENARIOS[target], stops=(stops // 2, stops // 2))
    samples, _ = simulate_samples(scenario, np.random.default_rng(0))
    config = configs.with_values(Config(), settings(scenario), target)
    times = []
    for _ in range(runs):
        start = time.process_time()
        pipeline.solve(samples, (), config, 'laser')
        times.append(time.process_time() - start)
    return float(np.median(times))


def profiles_a_second(target: str, rounds: int = 7) -> tuple[int, float]:
    """Return how many points a profile has, and how many are segmented in a second of CPU."""
    config = configs.load(ROOT / 'config' / f'{target}.yaml')
    recording = read_bag(ROOT / 'bags' / target, config)
    some = recording.profiles[::max(1, len(recording.profiles) // 300)]
    profiles = [profile.read(config.profile).points for profile in some]
    method, times = targets.target_for(config), []
    for _ in range(rounds):
        start = time.process_time()
        for points in profiles:
            with suppress(FeatureError):
                method.extract(points, config)
        times.append(time.process_time() - start)
    return len(profiles[0]), len(profiles) / min(times)


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
        columns, rate = profiles_a_second(target)
        print(f'{target:7} {columns} points: {rate:.0f} profiles a second of the processor, '
              f'{rate / NETWORK:.0f} times the {NETWORK} of a published network', flush=True)
    for target in ('plate', 'sphere'):
        few, many = solve_seconds(target, 18, 11), solve_seconds(target, 2000, 3)
        print(f'{target:7} 18 stops {1e3 * few:6.1f} ms, 2000 stops {many:6.2f} s, '
              f'ratio {many / few:5.1f}', flush=True)
    print(f'handeye solve, 40 s of 1280 points at 30 Hz: {bag_seconds():.2f} s')


if __name__ == '__main__':
    main()
