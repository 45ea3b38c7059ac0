#!/usr/bin/env python3
"""
What becomes of recordings many of whose samples are wrong.

usage: python bench/outliers.py [--seeds N] [--subsets N] [--only TARGET]

A share of the poses, drawn at random, is moved by SIZE (1 sigma of each axis, in m, and twice that
in rad). A row per target and case: how many answers are within 1 mm of the truth, how many are
not, how many recordings are refused, and the CPU seconds. --subsets: from how many random subsets
of the stations the search starts where all together do not fit.
"""
from __future__ import annotations

import argparse
from dataclasses import replace
import time

from handeye_ros import pipeline, se3
from handeye_ros.config import Config, with_values
from handeye_ros.errors import DataError
from handeye_ros.estimation import search
from handeye_ros.simulate import SCENARIOS, settings, simulate_samples
import numpy as np

CASES = ((0.2, 0.02), (0.3, 0.02), (0.3, 0.2), (0.33, 0.05))  # share, size
GOOD = 1e-3  # m
OUTCOMES = ('good', 'wrong', 'refused')


def outcome(target: str, share: float, size: float, seed: int) -> str:
    """Return what becomes of one recording."""
    scenario, rng = SCENARIOS[target], np.random.default_rng(seed + 100)
    every, truth = simulate_samples(scenario, np.random.default_rng(seed))
    samples = list(every)
    for i in rng.permutation(len(samples))[:round(share * len(samples))]:
        step = rng.normal(size=6) * size * np.repeat([1, 2], 3)
        samples[i] = replace(samples[i],
                             T_base_flange=se3.perturb(samples[i].T_base_flange, step))
    try:
        answer = pipeline.solve(samples, (), with_values(Config(), settings(scenario), target), '')
    except DataError:
        return 'refused'
    off = se3.difference(answer.T_flange_sensor, truth.T_flange_sensor)
    return 'good' if np.linalg.norm(off[:3]) < GOOD else 'wrong'


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seeds', type=int, default=4)
    parser.add_argument('--subsets', type=int, default=search.SUBSETS)
    parser.add_argument('--only', default='')
    arguments = parser.parse_args()
    search.SUBSETS = arguments.subsets
    print(f'{"target":8} {"share":>5} {"size, m":>7}', *OUTCOMES, '    s')
    for target in ('plate', 'sphere', 'plane', 'wedge', 'line'):
        for share, size in CASES if arguments.only in target else ():
            start = time.process_time()
            found = [outcome(target, share, size, seed) for seed in range(arguments.seeds)]
            counts = ' '.join(f'{found.count(name):>{len(name)}}' for name in OUTCOMES)
            print(f'{target:8} {share:5} {size:7} {counts} {time.process_time() - start:5.1f}',
                  flush=True)


if __name__ == '__main__':
    main()
