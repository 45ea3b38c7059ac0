#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Bad sessions must not be answered, good ones must not be refused.

usage: python bench/sessions.py [--trials N] [--seed S] [--only TEXT] [--workers W]

Simulates N bad and N good sessions (features with known noise, no profiles), spread evenly over
the kinds below, and prints a row per kind: how many were answered, how many of the answers were
wrong (mapped points off by more than 5 sigma and 0.3 mm), and the reasons of the refusals.
"""
from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
import math

from handeye_ros import config as configs
from handeye_ros import pipeline, se3
from handeye_ros.config import Config
from handeye_ros.data import Sample
from handeye_ros.errors import DataError
from handeye_ros.simulate import Scenario, SCENARIOS, settings, simulate_samples
from handeye_ros.simulate.robot import CONVENTION_ERRORS
import numpy as np
import trials

Damage = Callable[[list[Sample], np.random.Generator], list[Sample]]


@dataclass(frozen=True)
class Kind:
    """A kind of session: its cell, and what is done to its samples."""

    good: bool
    scenario: Scenario
    damage: Damage = lambda samples, rng: samples


def with_poses(samples: list[Sample], poses: np.ndarray) -> list[Sample]:
    """Return samples with other poses (n, 4, 4)."""
    return [replace(s, T_base_flange=T) for s, T in zip(samples, poses, strict=True)]


def poses_of(samples: list[Sample]) -> np.ndarray:
    """Return the poses (n, 4, 4) of samples."""
    return np.array([s.T_base_flange for s in samples])


def convention_error(name: str) -> Damage:
    """Return the damage that a convention error of the simulator does to all poses."""
    def apply(samples: list[Sample], rng: np.random.Generator) -> list[Sample]:
        T = poses_of(samples)
        translation, quaternion = CONVENTION_ERRORS[name](T[:, :3, 3], se3.quaternion(T))
        return with_poses(samples, se3.from_quaternion(translation, quaternion))
    return apply


def mispaired(samples: list[Sample], rng: np.random.Generator) -> list[Sample]:
    """Give every sample the pose of the station before."""
    return with_poses(samples, np.roll(poses_of(samples), 1, axis=0))


def moved(share: float, distance: float, together: bool) -> Damage:
    """Return the damage of poses moved by a distance, all alike or each its own way."""
    def apply(samples: list[Sample], rng: np.random.Generator) -> list[Sample]:
        T = poses_of(samples)
        wrong = rng.permutation(len(T))[:round(share * len(T))]
        ways = rng.normal(size=(1 if together else len(wrong), 3))
        T[wrong, :3, 3] += distance * ways / np.linalg.norm(ways, axis=1)[:, None]
        return with_poses(samples, T)
    return apply


def shuffled(samples: list[Sample], rng: np.random.Generator) -> list[Sample]:
    """Give every sample the pose of any station."""
    T = poses_of(samples)
    return with_poses(samples, T[rng.permutation(len(T))])


def kinds() -> dict[str, Kind]:
    """Return all kinds of sessions."""
    plate, sphere = SCENARIOS['plate'], SCENARIOS['sphere']
    tilted = replace(plate, tilt=math.radians(0.3))
    systematic = replace(plate.robot, systematic=(1.5e-4, math.radians(0.02)))
    found = {
        'plate': Kind(True, plate), 'sphere': Kind(True, sphere),
        'plate 5 + 5': Kind(True, SCENARIOS['plate_5_5']),
        'eye on base': Kind(True, SCENARIOS['eye_on_base']),
        'systematic robot': Kind(True, replace(plate, robot=systematic)),
        'systematic robot, sphere': Kind(True, replace(sphere, robot=systematic)),
        '2 stations at other edges': Kind(True, SCENARIOS['wrong_edges']),
        '20 % moved 5 mm': Kind(True, plate, moved(0.2, 5e-3, False)),
        '28 % moved 5 mm together': Kind(True, plate, moved(0.28, 5e-3, True)),
        'one orientation': Kind(False, SCENARIOS['one_orientation']),
        'one orientation per edge': Kind(False, SCENARIOS['one_orientation_per_edge']),
        'tilt only': Kind(False, SCENARIOS['tilt_only']),
        'yaw only': Kind(False, SCENARIOS['yaw_only']),
        'tilts of 0.3 degrees': Kind(False, tilted),
        'mispaired': Kind(False, plate, mispaired),
        'shuffled poses': Kind(False, plate, shuffled),
        'shuffled poses, sphere': Kind(False, sphere, shuffled),
        '60 % moved 5 mm': Kind(False, plate, moved(0.6, 5e-3, False)),
    }
    for name in CONVENTION_ERRORS:
        found[f'convention {name}'] = Kind(False, plate, convention_error(name))
        found[f'convention {name}, sphere'] = Kind(False, sphere, convention_error(name))
    return found


def session(job: tuple[str, int]) -> tuple[str, bool]:
    """Return the outcome of a session of a kind, by its name, and with a seed."""
    return outcome(kinds()[job[0]], job[1])


def outcome(kind: Kind, seed: int) -> tuple[str, bool]:
    """Return why a session was refused, '' for an answer, and whether the answer is wrong."""
    rng = np.random.default_rng(seed)
    samples, truth = simulate_samples(kind.scenario, rng)
    values = settings(kind.scenario) | {'noise.distortion': 0.0}
    config = configs.with_values(Config(), values, 'the scenario')
    try:
        found = pipeline.solve(kind.damage(list(samples), rng), (), config, 'laser')
    except DataError as error:
        return type(error).__name__, False
    delta = se3.difference(found.T_flange_sensor, truth.T_flange_sensor)
    sigmas = math.sqrt(delta @ np.linalg.solve(found.covariance, delta) / 6)
    lever = np.linalg.norm(delta[:3]) + 0.175 * np.linalg.norm(delta[3:])
    return '', sigmas > 5 and lever > 3e-4


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--trials', type=int, default=1000)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--only', default='', help='kinds whose name holds this text')
    trials.add_option(parser)
    arguments = parser.parse_args()
    chosen = {name: kind for name, kind in kinds().items() if arguments.only in name}
    totals = Counter(kind.good for kind in chosen.values())
    counts = {name: max(1, arguments.trials // totals[kind.good]) for name, kind in chosen.items()}
    outcomes = trials.results(session, [
        (name, arguments.seed + k) for name in chosen for k in range(counts[name])],
        arguments.workers)
    answered = Counter[bool]()
    print(f'{"session":28} {"trials":>6} {"answered":>8} {"wrong":>6}  refusals')
    for name, kind in chosen.items():
        count = counts[name]
        results = [next(outcomes) for _ in range(count)]
        reasons = Counter(reason for reason, _ in results if reason)
        answers = count - reasons.total()
        answered[kind.good] += answers
        print(f'{name:28} {count:6} {answers:8} {sum(w for _, w in results):6}  '
              + ', '.join(f'{r} {n}' for r, n in reasons.items()), flush=True)
    print(f'bad sessions answered: {answered[False]}; good sessions answered: {answered[True]}')


if __name__ == '__main__':
    main()
