#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A sensor or target that moves a little half-way must be told; a poor robot must not be called so.

usage: python bench/moves.py [--seeds N] [--first S] [--only TEXT] [--samples]

Simulates N recordings of each row (or features only) and prints how many were refused and how many
answered with a warning of a move, how many of these name the moment within one stop, and of those
not told how many answers were wrong (NEES > 12.6, the 95 % limit of six numbers). The rows without
a move are false alarms.
"""
from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
import re

from handeye_ros import pipeline, se3
from handeye_ros.config import Config, with_values
from handeye_ros.data import Array, Sample
from handeye_ros.errors import DataError
from handeye_ros.simulate import FAULTS, Scenario, settings, simulate, simulate_samples
import numpy as np
from scipy.stats import chi2

LIMIT = chi2.ppf(0.95, 6)
MOVES = {'sensor 3 mrad': (0.0, 3e-3), 'sensor 0.5 mm': (5e-4, 0.0), 'target 0.5 mm': (5e-4, 0.0)}
MOVED = ('baseline', 'sphere', 'plane', 'wedge')
GOOD = (*MOVED, 'line', 'distorted 0.02 mm', 'joints and links 0.1 mm', 'joints and links 0.3 mm',
        'smooth 0.2 mm', 'sphere, smooth 0.2 mm', 'plane, smooth 0.2 mm', 'wedge, smooth 0.2 mm',
        'repeatability 1.3 times stated')


def moved(samples: list[Sample], X: Array, what: str, rng: np.random.Generator) -> list[Sample]:
    """Return samples in order of time, the later half as if sensor or target had moved."""
    size = MOVES[what]
    step = np.concatenate([length * v / np.linalg.norm(v) for length, v in zip(
        size, rng.normal(size=(2, 3)), strict=True)])
    E = se3.perturb(np.eye(4), step)
    half = len(samples) // 2
    # the flange reported is that from which an unmoved sensor would have seen the same
    before = se3.inverse(X @ E @ se3.inverse(X))
    of_sensor = what.startswith('sensor')
    return samples[:half] + [
        replace(s, T_base_flange=s.T_base_flange @ before if of_sensor else E @ s.T_base_flange)
        for s in samples[half:]]


def outcome(scenario: Scenario, what: str, seed: int, of_samples: bool) -> str:
    """Return what becomes of a recording."""
    rng, config = np.random.default_rng(seed), with_values(Config(), settings(scenario), 'bench')
    if of_samples:
        found, truth = simulate_samples(scenario, rng)
    else:
        made = simulate(scenario, rng)
        truth, found = made.truth, pipeline.gather(made.profiles, made.poses, config).samples
    samples, X = sorted(found, key=lambda sample: sample.stamp), truth.T_flange_sensor
    half = len(samples) // 2
    try:
        answer = pipeline.solve(moved(samples, X, what, rng) if what else samples, (), config,
                                'laser')
    except DataError as error:
        return _when(str(error), half) or f'refused otherwise ({error.reason})'
    for warning in answer.provenance.get('warnings', ()):
        if result := _when(warning, half):
            return result.replace('refused', 'warned')
    delta = se3.difference(answer.T_flange_sensor, X)
    wrong = delta @ np.linalg.solve(answer.covariance, delta) > LIMIT
    return 'not told, wrong' if wrong else 'not told'


def _when(text: str, half: int) -> str:
    found = re.search(r'the first (\d+) (?:of \d+ )?samples', text)
    if not found:
        return ''
    return 'refused' if abs(int(found[1]) - half) < 2 else 'refused, other moment'


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--seeds', type=int, default=20)
    parser.add_argument('--first', type=int, default=0, help='the first seed')
    parser.add_argument('--only', default='', help='rows whose name holds this text')
    parser.add_argument('--samples', action='store_true', help='make features, no profiles')
    arguments = parser.parse_args()
    rows = [(name, what) for name in MOVED for what in MOVES] + [(name, '') for name in GOOD]
    for name, what in rows:
        title = f'{name}, {what or "nothing moved"}'
        if arguments.only in title:
            seeds = range(arguments.first, arguments.first + arguments.seeds)
            found = Counter(outcome(FAULTS[name], what, seed, arguments.samples) for seed in seeds)
            print(f'{title:40} ' + ', '.join(f'{n} {text}' for text, n in found.most_common()),
                  flush=True)


if __name__ == '__main__':
    main()
