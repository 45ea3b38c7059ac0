#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What the faults of real cells do to the answer: simulated profiles through the whole pipeline.

usage: python bench/physics.py [--seeds N] [--first S] [--only TEXT] [--workers W] [--samples]
                               [--stations N ...]

A row per cell of FAULTS in simulate/scenarios.py; its name says all that is wrong with it, and
the settings do not know of it. Over N recordings of each:
  answered  how many gave an answer; all the rest were refused, and the last column tells for
            what most often
  TRE       mm, median and 90 %: RMS error of points mapped from the middle of the field of view
            (0.2 to 0.8 of the range) into the flange, against the truth
  NEES      mean and median squared error of the six numbers of the answer, weighted by the
            stated covariance: 6 when that is true (median 5.3), more when the answer is too sure
            of itself
  in 95 %   the share of the answers whose stated 95 % region holds the truth
  s         CPU seconds of the calibration, median and slowest
How to read it: a fault that is found is modelled, and costs little TRE; one that is not found
must be inside the stated uncertainty. So a row is bad when TRE is large and NEES as well, or
when recordings that could carry an answer are refused. The rows of the first block have no
fault; those of the last one may well be refused, but must never be answered with a large TRE.

--stations replaces the number of stations of each cell; several numbers give several tables.
--samples makes the features directly, with the noise of ideal edges: quick, but of robots only.
--faces also solves the same samples as a plane, from their face lines alone, and adds
  faces     mm, median mapped error of that: edges that are not sharp should never make it worse
"""
from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import dataclass, replace
import time

from handeye_ros import pipeline, se3
from handeye_ros.config import Config, with_values
from handeye_ros.data import Array
from handeye_ros.errors import HandeyeError
from handeye_ros.results.truth_file import errors_against, field_points
from handeye_ros.simulate import (
    FAULTS,
    Scenario,
    settings,
    simulate,
    simulate_samples,
    Simulated,
)
from handeye_ros.simulate.sensor import FRAMES
import numpy as np
from scipy.stats import chi2
import trials

LIMIT = chi2.ppf(0.95, 6)
HEADER = (f'{"cell":32} {"answered":>9} {"TRE, mm":>7} {"90 %":>7} {"NEES":>7} {"median":>7} '
          f'{"in 95 %":>8} {"s":>5} {"worst":>5}  most are refused as')


@dataclass(frozen=True)
class Outcome:
    """
    An answer's errors (mapped points in m, squared Mahalanobis), or what was refused.

    faces: mapped points of the answer of the face lines alone (m).
    """

    seconds: float
    mapped: float = np.nan
    squared: float = np.nan
    refusal: str = ''
    faces: float = np.nan


def field(scenario: Scenario) -> Array:
    """Return the points (k, 3) of the published frame over which mapped points are compared."""
    (near, far), width = scenario.sensor.range, scenario.sensor.half_width
    x, depth = 0.95 * width * near, far - near
    points = field_points((-x, x), (near + 0.2 * depth, far - 0.2 * depth))
    T_standard_sensor = FRAMES[scenario.layout.frame].T_standard_sensor
    return se3.apply(se3.inverse(T_standard_sensor), points)


def of_faces(recording: Simulated, scenario: Scenario, config: Config) -> float:
    """Return the error of points mapped by the answer of the face lines alone (m), or nan."""
    plane = with_values(config, {'target.type': 'plane'}, config.name)
    try:
        session = pipeline.gather(recording.profiles, recording.poses, config)
        X = pipeline.solve(session.samples, (), plane, session.frame_id).T_flange_sensor
    except HandeyeError:
        return np.nan
    return errors_against(X, recording.truth.T_flange_sensor, field(scenario)).mapped_points


def trial(job: tuple[str, int, bool, bool, int]) -> Outcome:
    """
    Return what becomes of a recording.

    job: name of the cell, seed, if of samples, if of faces, stations (0: as the cell says).
    """
    name, seed, of_samples, faces, stations = job
    scenario, rng = with_stations(FAULTS[name], stations), np.random.default_rng(seed)
    config = with_values(Config(), settings(scenario), name)
    if of_samples:
        samples, truth = simulate_samples(scenario, rng)
    else:
        recording = simulate(scenario, rng)
        truth = recording.truth
    start = time.process_time()
    try:
        answer = pipeline.solve(samples, (), config, 'laser') if of_samples else (
            pipeline.calibrate(recording.profiles, recording.poses, config))
    except HandeyeError as error:
        cause = error.reason or type(error).__name__
        return Outcome(time.process_time() - start, refusal=f'{cause}: {error}')
    seconds = time.process_time() - start
    X, X_true = answer.T_flange_sensor, truth.T_flange_sensor
    delta = se3.difference(X, X_true)
    return Outcome(seconds, errors_against(X, X_true, field(scenario)).mapped_points,
                   float(delta @ np.linalg.solve(answer.covariance, delta)),
                   faces=of_faces(recording, scenario, config) if faces else np.nan)


def with_stations(scenario: Scenario, count: int) -> Scenario:
    """Return a scenario with so many stations, spread over its edges as before."""
    first, second = scenario.stations
    if not count:
        return scenario
    share = round(count / scenario.repeats * first / (first + second))
    return replace(scenario, stations=(share, count // scenario.repeats - share))


def row(name: str, outcomes: list[Outcome]) -> str:
    """Return the row of a cell."""
    good = [o for o in outcomes if not o.refusal]
    seconds = [o.seconds for o in outcomes]
    text = f'{name:32} {len(good):4}/{len(outcomes):<4}'
    if good:
        mapped = 1e3 * np.quantile([o.mapped for o in good], [0.5, 0.9])
        squared = np.array([o.squared for o in good])
        text += (f' {mapped[0]:7.3f} {mapped[1]:7.3f} {squared.mean():7.3g} '
                 f'{np.median(squared):7.3g} {100 * (squared < LIMIT).mean():7.0f}%')
    else:
        text += ' ' * 41
    text += f' {np.median(seconds):5.2f} {max(seconds):5.2f}'
    if not np.isnan([o.faces for o in good]).all():
        text += f' {1e3 * np.nanmedian([o.faces for o in good]):7.3f}'
    # figures differ from seed to seed; the kind of the refusal does not
    refusals = Counter(o.refusal.partition(':')[0] for o in outcomes if o.refusal)
    if refusals:
        kind, count = refusals.most_common(1)[0]
        text += f'  {count} x {kind}'
    return text


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--seeds', type=int, default=20)
    parser.add_argument('--first', type=int, default=0, help='the first seed')
    parser.add_argument('--only', default='', help='cells whose name holds this text')
    trials.add_option(parser)
    parser.add_argument('--refusals', action='store_true', help='print every refusal')
    parser.add_argument('--samples', action='store_true', help='make features, no profiles')
    parser.add_argument('--stations', type=int, nargs='+', default=[0], help='instead of its own')
    parser.add_argument('--faces', action='store_true', help='the face lines alone, too')
    arguments = parser.parse_args()
    names = [name for name in FAULTS if arguments.only in name
             and not (arguments.faces and FAULTS[name].scene != 'plate')]
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    cells = [(name, count) for count in arguments.stations for name in names]
    jobs = [(name, seed, arguments.samples, arguments.faces, count)
            for name, count in cells for seed in seeds]
    print(HEADER.replace('worst', 'worst   faces') if arguments.faces else HEADER, flush=True)
    outcomes = trials.results(trial, jobs, arguments.workers)
    for name, count in cells:
        found = [next(outcomes) for _ in seeds]
        print(row(f'{name}, {count}' if count else name, found), flush=True)
        for seed, outcome in zip(seeds, found, strict=True):
            if outcome.refusal and arguments.refusals:
                print(f'    seed {seed}: {outcome.refusal}')


if __name__ == '__main__':
    main()
