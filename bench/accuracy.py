#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
How near the estimator comes to the Cramer-Rao bound, and how honest its covariance is.

usage: python bench/accuracy.py [--seeds N] [--first S] [--only TEXT] [--workers W]

Simulates features with exactly known noise (no profiles) and solves each trial from nothing.
A row per case: RMSE over the bound (of one who knows that nothing else is wrong) for translation,
rotation and mapped points (over x within +-20 mm, range 160-190 mm); the share of trials whose
95 % region holds the truth; the mean squared Mahalanobis error over 6.
"""
from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
import math

from handeye_ros import config as configs
from handeye_ros import pipeline, se3
from handeye_ros.config import Config
from handeye_ros.data import Sample
from handeye_ros.estimation.noise import NoiseModel
from handeye_ros.estimation.posterior import posterior_at
from handeye_ros.estimation.solution import Solution
from handeye_ros.simulate import Scenario, SCENARIOS, simulate_samples
import numpy as np
from scipy.stats import chi2
import trials

NO_PRIORS = dict.fromkeys((
    'noise.distortion', 'noise.line_bend', 'noise.flatness', 'noise.robot_smooth',
    'noise.robot_scale', 'target.radius_std', 'target.size_std', 'target.edge_angle_std',
    'target.setback_std'), 0.0)
LIMIT = chi2.ppf(0.95, 6)


@dataclass(frozen=True)
class Case:
    """A simulated cell, and by which factors its noise is misjudged in the settings."""

    name: str
    scenario: Scenario
    sensor_factor: float = 1.0
    robot_factor: float = 1.0
    use_face: bool = False
    priors: bool = False


def cases() -> list[Case]:
    """Return the rows of the table."""
    found = []
    for target in ('plate', 'sphere'):
        scenario = SCENARIOS[target]
        for what, sensor, robot in (('noise known', 1, 1), ('sensor set 3 x', 3, 1),
                                    ('sensor set 1/3', 1 / 3, 1), ('robot set 3 x', 1, 3),
                                    ('robot set 1/3', 1, 1 / 3)):
            found.append(Case(f'{target}, {what}', scenario, sensor, robot))
        found.append(Case(f'{target}, priors as shipped', scenario, priors=True))
        model = replace(scenario.robot, systematic=(1.5e-4, math.radians(0.02)))
        found.append(Case(f'{target}, systematic robot', replace(scenario, robot=model),
                          priors=True))
    for target in ('line', 'plane'):
        found.append(Case(f'{target}, noise known', SCENARIOS[target]))
        found.append(Case(f'{target}, priors as shipped', SCENARIOS[target], priors=True))
    found.append(Case('line with its face, noise known', SCENARIOS['line'], use_face=True))
    return found


def configured(case: Case, robot_factor: float) -> Config:
    """Return the configuration that believes the robot's noise times a factor."""
    robot, sensor = case.scenario.robot, case.scenario.sensor
    return configs.with_values(Config(), ({} if case.priors else NO_PRIORS) | {
        'target.type': case.scenario.scene,
        'target.radius': float(getattr(case.scenario.target, 'radius', 0.0)),
        'target.use_face': case.use_face,
        'noise.sensor': sensor.noise,
        'noise.robot_translation': robot.repeatability[0] * robot_factor,
        'noise.robot_rotation': robot.repeatability[1] * robot_factor}, case.name)


def field_of_view() -> np.ndarray:
    """Return the points (n, 3) of the sensor frame over which mapped points are compared."""
    x, z = np.meshgrid(np.linspace(-0.02, 0.02, 9), np.linspace(0.16, 0.19, 7))
    return np.column_stack([x.ravel(), np.zeros(x.size), z.ravel()])


def misjudged(sample: Sample, factor: float) -> Sample:
    """Return a sample whose features state their noise times a factor."""
    names = ('std', 'std_across')
    return replace(sample, features=tuple(
        replace(f, **{name: getattr(f, name) * factor for name in names if hasattr(f, name)})
        for f in sample.features))


def bound(case: Case, solution: Solution) -> np.ndarray:
    """Return the bounds (3,) of the mean squares of translation, rotation and mapped points."""
    factors = np.array([case.sensor_factor ** -2] * 2 + [1.0] * 3)  # on the features' own errors
    problem = replace(solution.problem, config=configured(replace(case, priors=False), 1.0))
    C = posterior_at(problem, solution.estimate, NoiseModel(factors)).covariance[:6, :6]
    lever = field_of_view() @ solution.estimate.X[:3, :3].T
    J = np.concatenate([np.tile(np.eye(3), (len(lever), 1, 1)), -se3.skew(lever)], axis=2)
    mapped = np.einsum('nij,jk,nik->', J, C, J) / len(lever)
    return np.array([np.trace(C[:3, :3]), np.trace(C[3:, 3:]), mapped])


def trial(job: tuple[Case, int]) -> np.ndarray:
    """Return the squared errors (3), their bounds (3), and the squared Mahalanobis error."""
    case, seed = job
    samples, truth = simulate_samples(case.scenario, np.random.default_rng(seed))
    samples = tuple(misjudged(sample, case.sensor_factor) for sample in samples)
    config = configured(case, case.robot_factor)
    solution = pipeline.answer_samples(samples, (), config).require_solution()
    X, X_true = solution.estimate.X, truth.T_flange_sensor
    delta, points = se3.difference(X, X_true), field_of_view()
    off = se3.apply(X, points) - se3.apply(X_true, points)
    return np.array([delta[:3] @ delta[:3], delta[3:] @ delta[3:], (off ** 2).sum() / len(points),
                     *bound(case, solution),
                     trials.nees(X, solution.transform_covariance, X_true)])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    trials.add_options(parser, 500)
    arguments = parser.parse_args()
    chosen = [case for case in cases() if arguments.only in case.name]
    seeds = trials.seeds_of(arguments)
    outcomes = trials.results(trial, [(case, seed) for case in chosen for seed in seeds],
                              arguments.workers)
    print(f'{"case":32} {"transl.":>8} {"rotation":>8} {"mapped":>8} {"in 95 %":>8} {"Mahal.":>8}')
    for case in chosen:
        rows = np.array([next(outcomes) for _ in seeds])
        ratios = np.sqrt(rows[:, :3].mean(axis=0) / rows[:, 3:6].mean(axis=0))
        print(f'{case.name:32} {ratios[0]:8.3f} {ratios[1]:8.3f} {ratios[2]:8.3f} '
              f'{100 * (rows[:, 6] < LIMIT).mean():7.1f}% {rows[:, 6].mean() / 6:8.3f}',
              flush=True)


if __name__ == '__main__':
    main()
