#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
How well a robot that moves is calibrated: simulated sweeps through the whole pipeline.

usage: python bench/sweep.py [--seeds N] [--first S] [--only TEXT] [--known] [--workers W]

Sweeps of 30 s: a knot of a smooth curve every 1.6 s, tilts within 24 degrees, poses at 250 Hz with
a white error of 0.02 mm and 0.004 degrees each, profiles of 640 points at 50 Hz, noise 0.03 mm,
up to 0.3 mm wrong where a face is so steep that the light is lost; the profiles' clock is off by
the offset named. Over N recordings of each row:
  answered  how many gave an answer; what most of the others are refused for is told at the end
  TRE       mm, median and largest RMS error of mapped points (as in bench/physics.py)
  offset    ms, median and largest error of the time offset, and the median of its stated sigma
  NEES      mean squared error of the six numbers of the transform by the stated covariance, 6
            when that is true, and of the offset, 1 when true
  in 95 %   share of the answers whose stated region holds the truth: transform, offset
  s         CPU seconds of the calibration without reading profiles, median and slowest
The settings are as shipped, which allow for errors of sensor, target and robot that most of these
recordings do not have. With --known they allow for those that there are.
"""
from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
import math
import time

from accuracy import NO_PRIORS
from handeye_ros import pipeline, se3
from handeye_ros.config import Config, with_values
from handeye_ros.errors import HandeyeError
from handeye_ros.results.truth_file import errors_against, field_points
from handeye_ros.simulate import Scenario, SCENARIOS, settings, simulate
from handeye_ros.simulate.scenario import Sweep
import numpy as np
from scipy.stats import chi2
import trials

DURATION = 30.0  # s
LIMITS = chi2.ppf(0.95, 6), chi2.ppf(0.95, 1)
HEADER = (f'{"sweep":38} {"answered":>8} {"TRE, mm":>7} {"worst":>6} {"offs., ms":>9} '
          f'{"worst":>6} {"sigma":>6} {"NEES":>5} {"offs.":>5} {"in 95 %":>10} {"s":>4} '
          f'{"worst":>5}')


@dataclass(frozen=True)
class Outcome:
    """Errors of an answer: TRE (m), offset and its sigma (s), NEES (2,); or why there is none."""

    tre: float = math.nan
    offset: float = math.nan
    sigma: float = math.nan
    nees: tuple[float, float] = (math.nan, math.nan)
    seconds: float = math.nan
    refused: str = ''


def swept(name: str, offset: float = 0.0, knot: float = 1.6, rate: float = 250.0, **more: object
          ) -> Scenario:
    """Return a sweep over a target; more: of scenario.Sweep."""
    base, knots = SCENARIOS[name], round(DURATION / knot) + 1
    two = base.scene == 'plate'
    return replace(
        base, stations=(knots - knots // 2 * two, knots // 2 * two),
        tilt=min(math.radians(24), base.tilt),
        sensor=replace(base.sensor, columns=640, rate=50.0, delay=-offset),
        robot=replace(base.robot, rate=rate), sweep=Sweep(knot, **more))  # type: ignore[arg-type]


def cases() -> Iterator[tuple[str, Scenario]]:
    """Yield the rows of the table."""
    for target in ('plate', 'wedge', 'sphere', 'line', 'plane'):
        for ms in (0, 20, -35, 150):
            yield f'{target}, {ms} ms', swept(target, ms * 1e-3)
        yield f'{target}, fast', swept(target, 0.02, 0.9)
        yield f'{target}, slow', swept(target, 0.02, 4.0)
        smooth = swept(target, 0.02)
        yield f'{target}, robot smooth 0.1 mm', replace(
            smooth, robot=replace(smooth.robot, systematic=(1e-4, 3e-4)))
        yield f'{target}, no rotation', replace(swept(target, 0.02), motion='one_orientation')
    for target in ('plate', 'sphere'):
        yield f'{target}, poses at 100 Hz', swept(target, 0.02, rate=100.0)
        yield f'{target}, poses at 30 Hz', swept(target, 0.02, rate=30.0)
        yield f'{target}, poses at 1000 Hz', swept(target, 0.02, rate=1000.0)
        yield f'{target}, drift 0.1 mm in 1 s', swept(target, 0.02, drift=(1e-4, 3e-4))
        yield f'{target}, stamps jitter by 0.5 ms', swept(target, 0.02, stamp_jitter=5e-4)
        yield f'{target}, poses jitter, 0.1 mm, gaps', swept(
            target, 0.02, pose_jitter=1e-3, resolution=1e-4, gaps=5)
        yield f'{target}, exposure 2 ms', swept(target, 0.02, exposure=2e-3)
        yield f'{target}, rotation late by 10 ms', swept(target, 0.02, rotation_lag=0.01)
        based = replace(swept(target, 0.02), calibration_type='eye_on_base')
        yield f'{target}, sensor on the base', based


def trial(job: tuple[str, int, bool]) -> Outcome:
    """Return what becomes of one recording of a case; the last: with settings that are true."""
    scenario = dict(cases())[job[0]]
    made = simulate(scenario, np.random.default_rng(job[1]))
    values = settings(scenario) | {'sampling.mode': 'moving', 'noise.robot_translation': 3e-5,
                                   'noise.robot_rotation': 7e-5}
    if job[2]:
        assert scenario.sweep is not None
        smooth = math.hypot(scenario.robot.systematic[0], scenario.sweep.drift[0])
        values |= NO_PRIORS | {'noise.robot_smooth': smooth / math.sqrt(3)}
        values |= {'noise.distortion': 2e-5} if scenario.scene == 'wedge' else {}
    config = with_values(Config(), values, job[0])
    began = time.process_time()
    try:
        session = pipeline.gather(made.profiles, made.poses, config)
        began = time.process_time()
        found = pipeline.calibrate_session(session, config)
    except HandeyeError as error:
        return Outcome(refused=str(error), seconds=time.process_time() - began)
    seconds, truth = time.process_time() - began, made.truth
    assert found.time_offset is not None and truth.time_offset is not None
    delta = se3.difference(found.T_flange_sensor, truth.T_flange_sensor)
    off = found.time_offset.value - truth.time_offset
    return Outcome(
        errors_against(found.T_flange_sensor, truth.T_flange_sensor, field_of(scenario)
                       ).mapped_points, off, found.time_offset.std,
        (float(delta @ np.linalg.solve(found.covariance, delta)),
         (off / found.time_offset.std) ** 2), seconds)


def field_of(scenario: Scenario) -> np.ndarray:
    """Return the middle of the field of view (k, 3), 0.2 to 0.8 of the range."""
    near, far = scenario.sensor.range
    low, high = near + 0.2 * (far - near), near + 0.8 * (far - near)
    half = scenario.sensor.half_width * low
    return field_points((-half, half), (low, high))


def row(name: str, outcomes: list[Outcome]) -> str:
    """Return the row of a case."""
    good = [o for o in outcomes if not o.refused]
    head = f'{name:38} {f"{len(good)}/{len(outcomes)}":>8}'
    why = Counter(o.refused for o in outcomes if o.refused).most_common(1)
    result = f'\n    {why[0][1]} x {why[0][0][:200]}' if why else ''
    if not good:
        return head + result
    tre, off = (np.array([getattr(o, key) for o in good]) * 1e3 for key in ('tre', 'offset'))
    nees, seconds = np.array([o.nees for o in good]), [o.seconds for o in outcomes]
    inside = (nees < LIMITS).mean(axis=0) * 100
    return (f'{head} {np.median(tre):7.4f} {tre.max():6.3f} {np.median(abs(off)):9.4f} '
            f'{abs(off).max():6.3f} {1e3 * np.median([o.sigma for o in good]):6.3f} '
            f'{nees[:, 0].mean():5.1f} {nees[:, 1].mean():5.2f} '
            f'{inside[0]:4.0f} {inside[1]:4.0f}  {np.median(seconds):4.1f} {max(seconds):5.1f}'
            + result)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--seeds', type=int, default=20)
    parser.add_argument('--first', type=int, default=0)
    parser.add_argument('--only', default='')
    parser.add_argument('--known', action='store_true')
    trials.add_option(parser)
    args = parser.parse_args()
    print(HEADER)
    names = [name for name, _ in cases() if args.only in name]
    seeds = range(args.first, args.first + args.seeds)
    jobs = [(name, seed, args.known) for name in names for seed in seeds]
    outcomes = trials.results(trial, jobs, args.workers)
    for name in names:
        print(row(name, [next(outcomes) for _ in seeds]), flush=True)


if __name__ == '__main__':
    main()
