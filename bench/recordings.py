#!/usr/bin/env python3
"""
Error of whole simulated recordings, from profiles and poses to the transform.

usage: python bench/recordings.py [--seeds N]

For each scenario the RMS error of mapped points over x within +-20 mm, range 160-190 mm.
"""
from __future__ import annotations

import argparse

from handeye_ros import config as configs
from handeye_ros import pipeline
from handeye_ros.config import Config
from handeye_ros.results.truth_file import mapped_point_error
from handeye_ros.simulate import SCENARIOS, settings, simulate
import numpy as np

NAMES = ('plate', 'plate_in_order', 'plate_5_5', 'plate_omit', 'plate_resampled',
         'plate_clutter_high', 'sphere')


def error(name: str, seed: int) -> float:
    """Return the error of one recording in metres."""
    scenario = SCENARIOS[name]
    made = simulate(scenario, np.random.default_rng(seed))
    config = configs.with_values(Config(), settings(scenario), name)
    found = pipeline.calibrate(made.profiles, made.poses, config)
    return mapped_point_error(found.T_flange_sensor, made.truth.T_flange_sensor)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--seeds', type=int, default=20)
    seeds = parser.parse_args().seeds
    print(f'{"scenario":20} {"median, mm":>10} {"worst, mm":>10}   ({seeds} seeds)')
    for name in NAMES:
        errors = 1e3 * np.array([error(name, seed) for seed in range(seeds)])
        print(f'{name:20} {np.median(errors):10.4f} {errors.max():10.4f}', flush=True)


if __name__ == '__main__':
    main()
