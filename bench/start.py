#!/usr/bin/env python3
"""
How surely the search from nothing finds the answer, in cells as different as real ones are.

usage: python bench/start.py [--cells N] [--first S] [--only TARGET] [--worst]

Each cell is drawn: sensor 0.1 to 2 m from the flange, field 40 to 140 mm wide and also off
centre, zero of the range at the sensor or in the middle and counted either way, 7 to 40
stations, tilts of 10 to 45 degrees, programmes run once to three times, robots that err by up to
0.3 mm; the straight edge is that of a block, of which the sensor takes now the one, now the other
face, and often sees its other end too.
A row per target: the share of the cells in which the samples are explained as well as by the
solution that is started from the truth; the median and 95 % of the CPU time; how far the poor
ones are off (factor of the residual).
"""
from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
import math
import time

from handeye_ros import targets
from handeye_ros.config import Config, with_values
from handeye_ros.data import Array, EdgePoint, FaceLine, Feature, Sample
from handeye_ros.errors import HandeyeError
from handeye_ros.estimation.problem import Estimate, Problem, UNUSED
from handeye_ros.estimation.search import evaluate, fit, robust_solution
from handeye_ros.frames import mounted
from handeye_ros.se3 import transform
from handeye_ros.simulate import Scenario, settings, simulate_samples
from handeye_ros.simulate.scenario import PlateTarget, RobotModel, SensorModel, SphereTarget
import numpy as np

TARGETS = ('line', 'plate', 'plane', 'sphere')
FEWEST = {'line': 7, 'plate': 8, 'plane': 7, 'sphere': 7}
AS_GOOD, SLACK = 1.05, 4.0  # of the squared residuals, and added to them


@dataclass(frozen=True, eq=False)
class View:
    """How the driver counts: signs (2,) of x and range, and what is zero (2,), metres."""

    signs: Array
    zero: Array

    def feature(self, feature: Feature) -> Feature:
        """Return a feature of the standard sensor plane as the driver's numbers show it."""
        if isinstance(feature, FaceLine):
            return replace(feature, centre=self.seen(feature.centre),
                           direction=feature.direction * self.signs)
        if isinstance(feature, EdgePoint):
            return replace(feature, point=self.seen(feature.point),
                           direction=feature.direction * self.signs)
        return replace(feature, points=self.seen(feature.points),
                       centre=self.seen(feature.centre), raw=self.seen(feature.raw))

    def seen(self, points: Array) -> Array:
        """Return what the driver tells of places (..., 2) of the standard sensor plane."""
        return (points - self.zero) * self.signs

    def mount(self, T_mount_standard: Array) -> Array:
        """Return T_mount_sensor (4, 4) of the frame of the driver."""
        x, z = self.signs
        R = np.diag([x, x * z, z])
        return T_mount_standard @ transform(R, np.array([self.zero[0], 0.0, self.zero[1]]))


def drawn(target: str, rng: np.random.Generator) -> tuple[Scenario, View]:
    """Draw a cell."""
    width, depth = rng.uniform(0.04, 0.14), rng.uniform(0.02, 0.08)
    middle = rng.uniform(0.08, 0.35) + depth / 2
    sensor = SensorModel(range=(middle - depth / 2, middle + depth / 2),
                         half_width=width / 2 / middle, noise=rng.uniform(1e-5, 5e-5))
    lever = math.exp(rng.uniform(math.log(0.1), math.log(2.0)))
    error = rng.uniform(0, 3e-4)
    robot = RobotModel((3e-5, 7e-5), (error, error / 0.5))
    repeats = int(rng.choice([1, 1, 2, 3]))
    n = max(FEWEST[target], int(rng.integers(7, 41)) // repeats)
    first = int(rng.integers(4, n - 3)) if target == 'plate' else n
    made = {'line': PlateTarget(), 'plate': PlateTarget(),
            'plane': PlateTarget((0.6, 0.6), table=None),
            'sphere': SphereTarget(min(rng.uniform(0.0125, 0.04), 0.3 * width))}[target]
    scenario = Scenario(target, target, made, sensor, robot, stations=(first, n - first),
                        tilt=math.radians(rng.uniform(10, 45)), repeats=repeats,
                        lever=(lever, lever))
    zero = np.array([rng.choice([0.0, -1.0, 1.0]) * width / 2, rng.choice([0.0, middle])])
    return scenario, View(rng.choice([-1.0, 1.0], 2), zero)


def cell(target: str, seed: int) -> tuple[Problem, Estimate]:
    """Return what is to be solved, and the truth."""
    rng = np.random.default_rng([seed, TARGETS.index(target)])
    scenario, view = drawn(target, rng)
    samples, truth = simulate_samples(scenario, rng)
    if target == 'line':
        samples = tuple(two_ends(sample, rng) for sample in samples)
    samples = tuple(replace(s, features=tuple(map(view.feature, s.features))) for s in samples)
    sign = int(view.signs[1])
    config = with_values(Config(), settings(scenario) | {'profile.range_sign': sign}, 'bench')
    X, T = view.mount(truth.T_flange_sensor), truth.T_base_target
    size = getattr(scenario.target, 'size', (0.0, 0.0))
    plate = np.concatenate([T.ravel(), size, [np.pi / 2]])
    state = {'line': T.ravel(), 'plane': T.ravel(), 'plate': plate,
             'sphere': np.append(T[:3, 3], getattr(scenario.target, 'radius', 0.0))}[target]
    return posed(samples, config), Estimate(X, state)


def two_ends(sample: Sample, rng: np.random.Generator) -> Sample:
    """Return a sample as a block gives it: of either of two faces, with its other end or not."""
    face, edge = sample.features
    assert isinstance(face, FaceLine) and isinstance(edge, EdgePoint)
    inwards = -edge.direction * ([-1.0, 1.0] if rng.random() < 0.3 else [1.0, 1.0])
    width = rng.uniform(0.01, 0.05)
    face = replace(face, centre=edge.point + inwards * width / 2, direction=inwards,
                   spread=width / 4)
    edge = replace(edge, direction=-inwards, std=5e-6, std_across=5e-6, kind='roof')
    other = replace(edge, point=edge.point + inwards * width, direction=inwards, std=1.2e-5,
                    kind='gap')
    return replace(sample, features=(face, edge, other) if rng.random() < 0.7 else (face, edge))


def posed(samples: tuple[Sample, ...], config: Config) -> Problem:
    """Return the problem of samples."""
    method = targets.method_for(config)
    return Problem(method, mounted(samples, config), method.observe(samples), config)


def from_truth(problem: Problem, truth: Estimate) -> float:
    """Return the squared whitened residuals per condition of the solution near the truth."""
    p = problem.points_in_base(truth.X)
    obs = problem.method.relabel(problem.observations, p, truth.target, problem.config)
    problem = replace(problem, observations=obs.select(obs.kind != UNUSED))
    solution = evaluate(problem, fit(problem, truth))
    return float(solution.white @ solution.white)


def trial(target: str, seed: int) -> tuple[float, float, str]:
    """Return the factor of the squared residuals over those from the truth, the time, a note."""
    problem, truth = cell(target, seed)
    best = from_truth(problem, truth)
    start = time.process_time()
    try:
        found = robust_solution(problem, np.random.default_rng(0), True)
    except HandeyeError as error:
        return np.inf, time.process_time() - start, type(error).__name__
    seconds = time.process_time() - start
    cost = float(found.white @ found.white)
    worse = len(found.dropped) > 0.2 * len(problem.poses)
    note = f'{len(problem.poses)} stations, {len(found.dropped)} dropped'
    return (np.inf if worse else cost / (best * AS_GOOD + SLACK)), seconds, note


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--cells', type=int, default=400)
    parser.add_argument('--first', type=int, default=0, help='the first seed')
    parser.add_argument('--only', default='', help='one target')
    parser.add_argument('--worst', action='store_true', help='print the poor ones')
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.cells)
    print(f'{"target":8} {"found":>14} {"ms":>7} {"95 %":>7}  poor ones')
    for target in TARGETS:
        if arguments.only not in target:
            continue
        found = [trial(target, seed) for seed in seeds]
        factor, seconds = np.array([f[0] for f in found]), np.array([f[1] for f in found])
        good = factor <= 1
        times = 1e3 * np.quantile(seconds, [0.5, 0.95])
        poor = ' '.join(f'{math.sqrt(f):.1f}' for f in np.sort(factor[~good])[:8])
        print(f'{target:8} {good.sum():5}/{len(seeds):<4} {100 * good.mean():5.1f}% '
              f'{times[0]:6.1f} {times[1]:7.1f}  {poor}', flush=True)
        for seed, (f, s, note) in zip(seeds, found, strict=True):
            if f > 1 and arguments.worst:
                print(f'    seed {seed}: {math.sqrt(f):8.1f} {1e3 * s:6.0f} ms, {note}')


if __name__ == '__main__':
    main()
