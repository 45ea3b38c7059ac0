# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Simulated cells: what the sensor sees, what is true of it, and the settings, together.

cell('plate', seed=3): samples of features with exactly known noise; exact_cell: without noise
recorded('plate', seed=3): a recording of rendered profiles, so all steps are tested; slower
simulated(scenario, seed): a recording with all of its profiles and poses; slower still
noisy, solution_of, calibration_of: a cell of each method, solved once for all tests

Keywords are settings, with __ for the dot: cell('sphere', target__radius=0.0).
"""
from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from handeye_ros import pipeline, se3, targets
from handeye_ros.config import Config, with_values
from handeye_ros.data import Array, Calibration, Profile, Sample, TimedPose
from handeye_ros.errors import DataError
from handeye_ros.estimation.problem import Estimate, Problem
from handeye_ros.estimation.search import robust_solution
from handeye_ros.estimation.solution import converged_fit, posteriors_of_fit, Solution
from handeye_ros.results.truth import errors_against
from handeye_ros.simulate import Scenario, SCENARIOS, settings, simulate, simulate_samples, Truth
from handeye_ros.simulate.sensor import FRAMES
import numpy as np
import pytest
from streams import in_order

NO_DOUBTS = {'noise__distortion': 0.0, 'noise__flatness': 0.0, 'noise__robot_smooth': 0.0,
             'noise__robot_scale': 0.0, 'noise__line_bend': 0.0, 'target__radius_std': 0.0,
             'target__size_std': 0.0, 'target__edge_angle_std': 0.0, 'target__setback_std': 0.0}
EXACT_COLUMNS = 10 ** 12  # so fine that an edge has no sampling error
EDGED = ('plate', 'line')  # scenes with edges; they only count the columns
# squared errors, of chi-squared over 6, that one true answer in so many exceeds
ONE_IN_20, ONE_IN_100, ONE_IN_1000 = 12.59, 16.81, 22.46
ANY_POSE = se3.transform(se3.exp_rotation(np.array([0.7, -1.1, 0.4])), np.array([0.3, -0.2, 0.9]))


@dataclass(frozen=True, eq=False)
class Cell:
    """Samples of a simulated cell, what is true of it, and the settings that fit it."""

    scenario: Scenario
    samples: tuple[Sample, ...]
    truth: Truth
    config: Config

    @property
    def problem(self) -> Problem:
        return targets.problem_of_known_poses(self.samples, self.config)

    def solve(self, samples: Iterable[Sample] | None = None, **values: object) -> Calibration:
        """Return the calibration from its samples, or others in their place, with settings."""
        return pipeline.solve(self.samples if samples is None else [*samples], [],
                              set_to(self.config, **values), 'laser')

    def error(self, T: Array) -> float:
        """Return the RMS error of points mapped by T, in metres."""
        return field_error(T, self.truth, self.scenario)


def cell(scenario: str | Scenario = 'plate', seed: int = 0, **values: object) -> Cell:
    """
    Return a cell of features with exactly known noise, and settings that doubt nothing else.

    values: settings, __ for the dot.
    """
    scenario = SCENARIOS[scenario] if isinstance(scenario, str) else scenario
    samples, truth = simulate_samples(scenario, np.random.default_rng(seed))
    return Cell(scenario, samples, truth, settings_of(scenario, **(NO_DOUBTS | values)))


def set_to(config: Config, **values: object) -> Config:
    """Return settings with values put in; __ stands for the dot of a key."""
    dotted = {key.replace('__', '.'): value for key, value in values.items()}
    return with_values(config, dotted, 'test')


def settings_of(scenario: Scenario, **values: object) -> Config:
    """Return the settings of a scenario, with values put in."""
    return set_to(Config(), **{key.replace('.', '__'): value for key, value in
                               settings(scenario).items()} | values)


def squared_error(estimate: Any, truth: Any) -> float:
    """Return the squared error of a transform, in its covariance; see ONE_IN_20."""
    error = se3.difference(estimate.T_flange_sensor, truth.T_flange_sensor)
    return float(error @ np.linalg.solve(estimate.covariance, error))


def exact(scenario: str | Scenario = 'plate') -> Scenario:
    """Return a scenario without any noise of sensor or robot, for samples of features."""
    scenario = SCENARIOS[scenario] if isinstance(scenario, str) else scenario
    fine = {'columns': EXACT_COLUMNS} if scenario.scene in EDGED else {}
    return replace(scenario, sensor=replace(scenario.sensor, noise=1e-12, **fine),
                   robot=replace(scenario.robot, repeatability=(0.0, 0.0), systematic=(0.0, 0.0)))


def exact_cell(scenario: str | Scenario = 'plate', seed: int = 0, **values: object) -> Cell:
    """Return a cell without noise; the settings keep believing in some."""
    noise = {'noise__sensor': 3e-5, 'noise__robot_translation': 2e-5,
             'noise__robot_rotation': 7e-5}
    return cell(exact(scenario), seed, **(noise | values))


def solved(problem: Problem, seed: int = 0) -> Solution:
    """Return the solution from nothing."""
    return robust_solution(problem, np.random.default_rng(seed))


def map_solution(problem: Problem, start: Estimate) -> Solution:
    """Return the solution of all stations near a start, with all blocks."""
    return Solution(*posteriors_of_fit(problem, converged_fit(problem, start)), problem,
                    np.arange(len(problem.poses)), {})


def field_error(T: Array, truth: Truth, scenario: Scenario) -> float:
    """Return the RMS error over the field of view that is x +-20 mm, range 160-190 mm."""
    T_sensor_standard = se3.inverse(FRAMES[scenario.frame].T_standard_sensor)
    return errors_against(T @ T_sensor_standard,
                          truth.T_flange_sensor @ T_sensor_standard).mapped_points


@dataclass(frozen=True, eq=False)
class Recorded:
    """A simulated recording, what is true of it, and the settings that read it."""

    scenario: Scenario
    profiles: tuple[Profile, ...]
    poses: tuple[TimedPose, ...]
    truth: Truth
    config: Config

    @property
    def messages(self) -> list[TimedPose | Profile]:
        """Return poses and profiles in the order of their stamps."""
        return in_order(self.poses, self.profiles)

    def calibrate(self, profiles: Iterable[Profile] | None = None,
                  poses: Iterable[TimedPose] | None = None, **values: object) -> Calibration:
        """Return the calibration from it, or from other profiles or poses, with settings."""
        return pipeline.calibrate(self.profiles if profiles is None else profiles,
                                  self.poses if poses is None else poses,
                                  set_to(self.config, **values))

    def error(self, T: Array) -> float:
        """Return the RMS error of points mapped by T, in metres."""
        return field_error(T, self.truth, self.scenario)


def recorded(scenario: str | Scenario = 'plate', seed: int = 0, rate: float = 10.0,
             columns: int | None = None, **values: object) -> Recorded:
    """Return a recording with fewer profiles and poses than the scenario's, to be quick."""
    scenario = SCENARIOS[scenario] if isinstance(scenario, str) else scenario
    sensor = replace(scenario.sensor, rate=rate, thinning=3)
    sensor = replace(sensor, columns=columns or sensor.columns)
    quick = replace(scenario, sensor=sensor, robot=replace(scenario.robot, rate=50.0))
    return simulated(quick, seed, **values)


def simulated(scenario: Scenario, seed: int, **values: object) -> Recorded:
    """Return a recording as the scenario has it; values: settings, __ for the dot."""
    recording = simulate(scenario, np.random.default_rng(seed))
    return Recorded(scenario, recording.profiles, recording.poses, recording.truth,
                    settings_of(scenario, **values))


every_target = pytest.mark.parametrize('name', targets.TARGETS)


@lru_cache
def noisy(name: str, where: str = 'eye_in_hand', seed: int = 0) -> Cell:
    return cell(replace(SCENARIOS[name], calibration_type=where), seed)


@lru_cache
def solution_of(name: str, where: str = 'eye_in_hand', seed: int = 0) -> Solution:
    return solved(noisy(name, where, seed).problem)


@lru_cache
def calibration_of(name: str) -> Calibration:
    return noisy(name).solve()


@contextmanager
def refused(code: str, words: str | None = None) -> Iterator[pytest.ExceptionInfo[DataError]]:
    """Expect a refusal with this code, in a sentence that matches the words."""
    with pytest.raises(DataError, match=words) as caught:
        yield caught
    assert caught.value.code == code


def apart(a: Array, b: Array) -> float:
    """Return the largest difference between two transforms, m or rad."""
    return float(np.abs(se3.difference(a, b)).max())
