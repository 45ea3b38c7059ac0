#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What the faults of real cells do to the answer: simulated profiles through the whole pipeline.

usage: python bench/physics.py [--sweeps] [--seeds N] [--first S] [--only TEXT] [--workers W]
                               [--samples] [--stops N ...] [--refusals]

A row per cell of FAULTS in simulate/scenario.py; its name says all that is wrong with it, and
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

--sweeps: a robot that moves all the time. Sweeps of 30 s: a knot of a smooth curve every 1.6 s,
tilts within 24 degrees, poses at 250 Hz with a white error of 0.02 mm and 0.004 degrees each,
profiles of 640 points at 50 Hz; the profiles' clock is off by the offset named. Then also:
  offset    ms, median and largest error of the time offset, and the median of its stated sigma;
            its NEES (1 when true), and its share in the stated region
--stops replaces the number of stops of each cell; several numbers give several tables.
--samples makes the features directly, with the noise of ideal edges: quick, but of robots only.
"""
from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
import math
import time

from handeye_ros import pipeline
from handeye_ros.config import Config, with_values
from handeye_ros.errors import HandeyeError
from handeye_ros.results.truth import errors_against
from handeye_ros.simulate import FAULTS, Scenario, SCENARIOS, settings, simulate, simulate_samples
from handeye_ros.simulate.scenario import changed, Sweep, swept
import numpy as np
from scipy.stats import chi2
import trials

DURATION = 30.0  # s of a sweep
LIMIT, LIMIT_OF_OFFSET = chi2.ppf(0.95, 6), chi2.ppf(0.95, 1)
HEADER = (f'{"cell":38} {"answered":>9} {"TRE, mm":>7} {"90 %":>7} {"NEES":>7} {"median":>7} '
          f'{"in 95 %":>8} {"s":>5} {"worst":>5}  most are refused as')


@dataclass(frozen=True)
class Outcome:
    """
    An answer's errors, or what was refused.

    mapped: RMS of mapped points (m); squared: squared Mahalanobis error; offset: error of the time
    offset and its sigma (s), of a sweep.
    """

    seconds: float
    mapped: float = math.nan
    squared: float = math.nan
    offset: tuple[float, float] = (math.nan, math.nan)
    refusal: str = ''


def sweep_of(target: str, offset: float = 0.02, knot: float = 1.6, rate: float = 250.0,
             **sweep: object) -> Scenario:
    """Return a sweep over a target; sweep: values of scenario.Sweep."""
    base, knots = SCENARIOS[target], round(DURATION / knot) + 1
    second = knots // 2 * (base.scene == 'plate')
    scenario = swept(base, target, poses=rate, delay=-offset, rim_bias=base.sensor.rim_bias)
    return replace(scenario, stops=(knots - second, second),
                   sweep=Sweep(knot, **sweep))  # type: ignore[arg-type]


def sweeps() -> Iterator[tuple[str, Scenario]]:
    """Yield the rows of robots that move."""
    for target in ('plate', 'sphere', 'line', 'plane', 'wedge'):
        for ms in (0, 20, -35, 150):
            yield f'{target}, {ms} ms', sweep_of(target, ms * 1e-3)
        yield f'{target}, fast', sweep_of(target, knot=0.9)
        yield f'{target}, slow', sweep_of(target, knot=4.0)
        yield f'{target}, robot smooth 0.1 mm', changed(
            sweep_of(target), target, robot={'systematic': (1e-4, 3e-4)})
        yield f'{target}, no rotation', replace(sweep_of(target), motion='one_orientation')
    for target in ('plate', 'sphere'):
        for rate in (100, 30, 1000):
            yield f'{target}, poses at {rate} Hz', sweep_of(target, rate=float(rate))
        yield f'{target}, drift 0.1 mm in 1 s', sweep_of(target, drift=(1e-4, 3e-4))
        yield f'{target}, stamps jitter by 0.5 ms', sweep_of(target, stamp_jitter=5e-4)
        yield f'{target}, poses jitter, 0.1 mm, gaps', sweep_of(
            target, pose_jitter=1e-3, resolution=1e-4, gaps=5)
        yield f'{target}, exposure 2 ms', sweep_of(target, exposure=2e-3)
        yield f'{target}, rotation late by 10 ms', sweep_of(target, rotation_lag=0.01)
        yield f'{target}, sensor on the base', replace(
            sweep_of(target), calibration_type='eye_on_base')


def with_stops(scenario: Scenario, count: int) -> Scenario:
    """Return a scenario with so many stops, spread over its edges as before."""
    first, second = scenario.stops
    share = round(count / scenario.repeats * first / (first + second))
    return replace(scenario, stops=(share, count // scenario.repeats - share))


def trial(job: tuple[Scenario, int, bool]) -> Outcome:
    """Return what becomes of a recording of a scenario, with a seed; or of samples alone."""
    scenario, seed, of_samples = job
    rng, values = np.random.default_rng(seed), settings(scenario)
    if scenario.sweep:
        values |= {'sampling.mode': 'moving', 'noise.robot_translation': 3e-5,
                   'noise.robot_rotation': 7e-5}
    config = with_values(Config(), values, scenario.name)
    if of_samples:
        samples, truth = simulate_samples(scenario, rng)
        solve = partial(pipeline.solve, samples, (), config, 'laser')
    else:
        made = simulate(scenario, rng)
        truth, solve = made.truth, partial(pipeline.calibrate, made.profiles, made.poses, config)
    start = time.process_time()
    try:
        answer = solve()
    except HandeyeError as error:
        cause = error.code or type(error).__name__
        return Outcome(time.process_time() - start, refusal=f'{cause}: {error}')
    seconds, X_true = time.process_time() - start, truth.T_flange_sensor
    X, field = answer.T_flange_sensor, trials.field_of(scenario)
    offset = (math.nan, math.nan)
    if answer.time_offset and truth.time_offset is not None:
        offset = (answer.time_offset.value - truth.time_offset, answer.time_offset.std)
    return Outcome(seconds, errors_against(X, X_true, field).mapped_points,
                   trials.nees(X, answer.covariance, X_true), offset)


def row(name: str, outcomes: list[Outcome]) -> str:
    """Return the row of a cell."""
    good = [o for o in outcomes if not o.refusal]
    seconds = [o.seconds for o in outcomes]
    text = f'{name:38} {len(good):4}/{len(outcomes):<4}'
    if good:
        mapped = 1e3 * np.quantile([o.mapped for o in good], [0.5, 0.9])
        squared = np.array([o.squared for o in good])
        text += (f' {mapped[0]:7.3f} {mapped[1]:7.3f} {squared.mean():7.3g} '
                 f'{np.median(squared):7.3g} {100 * (squared < LIMIT).mean():7.0f}%')
    else:
        text += ' ' * 41
    text += f' {np.median(seconds):5.2f} {max(seconds):5.2f}'
    off, sigma = np.array([o.offset for o in good]).reshape(-1, 2).T
    if np.isfinite(off).any():
        squared = (off / sigma) ** 2
        text += (f'  offset {1e3 * np.median(abs(off)):.4f} {1e3 * abs(off).max():.3f} '
                 f'{1e3 * np.median(sigma):.3f} {squared.mean():.2f} '
                 f'{100 * (squared < LIMIT_OF_OFFSET).mean():.0f}%')
    # figures differ from seed to seed; the kind of the refusal does not
    refusals = Counter(o.refusal.partition(':')[0] for o in outcomes if o.refusal)
    if refusals:
        kind, count = refusals.most_common(1)[0]
        text += f'  {count} x {kind}'
    return text


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    trials.add_options(parser, 20)
    parser.add_argument('--sweeps', action='store_true', help='robots that move all the time')
    parser.add_argument('--samples', action='store_true', help='make features, no profiles')
    parser.add_argument('--stops', type=int, nargs='+', default=[0], help='instead of its own')
    parser.add_argument('--refusals', action='store_true', help='print every refusal')
    arguments = parser.parse_args()
    cells = [(f'{name}, {count}' if count else name,
              with_stops(scenario, count) if count else scenario)
             for count in arguments.stops
             for name, scenario in (sweeps() if arguments.sweeps else FAULTS.items())
             if arguments.only in name]
    seeds = trials.seeds_of(arguments)
    outcomes = trials.results(trial, [(scenario, seed, arguments.samples)
                                      for _, scenario in cells for seed in seeds],
                              arguments.workers)
    print(HEADER, flush=True)
    for name, _ in cells:
        found = [next(outcomes) for _ in seeds]
        print(row(name, found), flush=True)
        for seed, outcome in zip(seeds, found, strict=True):
            if outcome.refusal and arguments.refusals:
                print(f'    seed {seed}: {outcome.refusal}')


if __name__ == '__main__':
    main()
