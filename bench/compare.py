#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Our estimators beside the published ones, on the same simulated samples.

usage: python bench/compare.py [--trials N] [--seed S] [--only TARGET] [--brief]

Simulates features with known noise (no profiles), which the settings state, and runs what
`handeye compare` runs. A row per estimator: medians of error (translation, rotation, mapped
points over x within +-20 mm, range 160-190 mm; and its worst); then each median over ours, with
its 95 % interval (see bench/paired.py). A second table holds the medians of residual and time.
--brief: a line per target, our medians and the nearest published one in each quantity.
The line has one more row: what our line makes of the face lines in the same samples.
"""
from __future__ import annotations

import argparse
from collections import defaultdict
import math

from handeye_ros import config as configs
from handeye_ros.config import Config
from handeye_ros.published.compare import compare, Row
from handeye_ros.simulate import SCENARIOS, settings, simulate_samples
import numpy as np
from paired import print_header, print_nearest, print_table

TARGETS = ('plate', 'sphere', 'line', 'plane')
WITH_FACE = 'line, with its face'
OURS = (WITH_FACE, 'plane, the face lines alone', 'line, one edge alone')
NOTHING = (math.nan,) * 3


def trial(target: str, seed: int) -> dict[str, Row]:
    """Return the rows of one simulated cell by name."""
    scenario = SCENARIOS[target]
    samples, truth = simulate_samples(scenario, np.random.default_rng(seed))
    values = settings(scenario) | {'noise.distortion': 0.0}  # features are made without
    config = configs.with_values(Config(), values, 'the scenario')
    rows = compare(samples, (), config, truth.T_flange_sensor, folds=0).rows
    found = {row.name: row for row in rows}
    if target == 'line':
        config = configs.with_values(Config(), values | {'target.use_face': True}, 'the scenario')
        found[WITH_FACE] = compare(samples, (), config, truth.T_flange_sensor, folds=0).rows[0]
    return found


def run(target: str, seeds: range) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return errors (n, 3) of each estimator (mm, degrees, mm), and residual (mm), seconds."""
    errors, others = defaultdict(list), defaultdict(list)
    for seed in seeds:
        for name, row in trial(target, seed).items():
            errors[name].append(NOTHING if row.error_translation is None else (
                1e3 * row.error_translation, math.degrees(row.error_rotation),
                1e3 * row.error_mapped_points))
            others[name].append((1e3 * (row.residual_rms or math.nan), row.seconds))
    return ({name: np.array(values) for name, values in errors.items()},
            {name: np.array(values) for name, values in others.items()})


def print_others(found: dict[str, np.ndarray]) -> None:
    """Print the medians of residual and time of each estimator."""
    print(f'{"":28} {"residual, mm":>12} {"time, s":>8}')
    for name, values in found.items():
        residual, seconds = np.nanmedian(values, axis=0)
        print(f'{name:28} {residual:12.4f} {seconds:8.4f}')
    print(flush=True)


def main() -> None:
    """Print the tables of each target, or a line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--trials', type=int, default=50)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--only', choices=TARGETS)
    parser.add_argument('--brief', action='store_true', help='a line per target')
    arguments = parser.parse_args()
    if arguments.brief:
        print(f'{arguments.trials} trials')
        print_header()
    for target in (arguments.only,) if arguments.only else TARGETS:
        found, others = run(target, range(arguments.seed, arguments.seed + arguments.trials))
        if arguments.brief:
            print_nearest(target, found, OURS)
            continue
        print_table(f'{target}, {arguments.trials} trials', found)
        print_others(others)


if __name__ == '__main__':
    main()
