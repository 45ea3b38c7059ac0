# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What `handeye check` names, over seeds: false alarms, and the causes of changes.

usage: .venv/bin/python bench/check.py [--first SEED] [--turned N] [SEEDS] [TARGET...]

For each of SEEDS (default 20) a simulated cell (sensor 0.03 mm, robot 0.02 mm and 0.004 degrees)
is calibrated from 18 stops; then the same target is seen from other stops, with nothing changed,
with the target moved (0.3 mm along the normal of its face and 0.05 degrees), with the sensor
moved on the flange (0.3 mm and 0.1 degrees), and with joint 5 of a six-axis arm off by 0.05 and
by 0.2 degrees. "right": the cause is named, alone or with others that the stops cannot tell from
it; "alone": and no other; "missed": nothing seems to have changed. --turned: so many of the stops
are repeated with the sensor turned by 90 degrees about its z, as a check asks for.
"""
from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

from handeye_ros import pipeline, se3
from handeye_ros.config import Config, NoiseConfig, with_values
from handeye_ros.data import Array, Calibration, Sample
from handeye_ros.simulate import arm, gauges
from handeye_ros.simulate.scenario import PlateTarget, RobotModel, Scenario, SphereTarget
from handeye_ros.simulate.scenarios import SCENARIOS
from handeye_ros.simulate.scenes import SCENES
from handeye_ros.simulate.stations import Stops
from handeye_ros.verification.check import Check, check
import numpy as np
from scipy.spatial.transform import Rotation

STOPS = 8  # of a check
ROBOT = RobotModel()
NOISE = NoiseConfig(3e-5, robot_translation=ROBOT.repeatability[0],
                    robot_rotation=ROBOT.repeatability[1])
TARGETS = {'plate': PlateTarget(table=None), 'plane': PlateTarget(table=None),
           'line': PlateTarget(table=None), 'sphere': SphereTarget(0.02, None, False),
           'wedge': SCENARIOS['wedge'].target}
TRUTH = {'unchanged': 'unchanged', 'target': 'target', 'sensor': 'sensor', 'joint 0.05': 'robot',
         'joint 0.2': 'robot'}


def cell(kind: str, rng: np.random.Generator) -> tuple[Scenario, Config, Array, Array]:
    """Return scenario, configuration, T_flange_sensor and T_base_target that an arm reaches."""
    scenario = replace(SCENARIOS[kind], target=TARGETS[kind], robot=ROBOT, tilt=np.deg2rad(30))
    config = with_values(Config(noise=NOISE), {
        'target.type': kind, 'target.radius': 0.02 if kind == 'sphere' else 0.0}, 'bench')
    X = se3.transform(Rotation.from_rotvec(rng.uniform(-0.3, 0.3, 3)).as_matrix(),
                      rng.uniform(-0.1, 0.1, 3))
    T = se3.transform(Rotation.from_euler('z', rng.uniform(-0.5, 0.5)).as_matrix(),
                      rng.uniform([0.6, -0.2, 0.1], [0.75, 0.2, 0.3]))
    return scenario, config, X, T


def with_turned(stops: Stops, count: int) -> Stops:
    """Return the stops, and some again, turned by 90 degrees about what they see."""
    turn, poses = Rotation.from_euler('z', np.pi / 2).as_matrix(), stops.T_target_sensor
    again = np.linspace(0, len(poses) - 1, count).astype(int)
    centre = np.insert(stops.points[again], 1, 0.0, axis=1)
    turned = poses[again] @ se3.transform(np.broadcast_to(turn, (count, 3, 3)),
                                          centre - centre @ turn.T)
    return Stops(np.concatenate([poses, turned]),
                 stops.labels + tuple(stops.labels[k] for k in again),
                 np.concatenate([stops.points, stops.points[again]]))


def samples(scenario: Scenario, count: int, X: Array, T: Array, rng: np.random.Generator,
            joint: float = 0.0, turned: int = 0) -> list[Sample]:
    """Return the samples of some stops; joint: by how much joint 5 is off (rad)."""
    scenario = replace(scenario, stations=((count + 1) // 2, count // 2) if
                       scenario.scene == 'plate' else (count, 0))
    stops = with_turned(SCENES[scenario.scene].stops(scenario, rng), turned)
    found = gauges.stations(scenario, X, T, stops, rng)
    if not joint:
        return list(found)
    offsets = np.array([0, 0, 0, 0, joint, 0.0])
    errors = arm.ArmErrors(np.zeros((6, 6)), offsets, np.zeros(6), np.zeros(6))
    poses = np.array([s.T_base_flange for s in found])
    reported = se3.perturb(poses, arm.reported_error(poses, errors))
    return [replace(s, T_base_flange=one) for s, one in zip(found, reported, strict=True)]


def trials(kind: str, seed: int, turned: int = 0) -> Iterator[tuple[str, Check]]:
    """Yield what was changed, and what is said of it."""
    rng = np.random.default_rng(seed)
    while True:
        scenario, config, X, T = cell(kind, rng)
        try:
            calibration = pipeline.solve(samples(scenario, 18, X, T, rng), [], config, 'laser')
            samples(scenario, 40, X, T, np.random.default_rng(0), 1e-3)
            break
        except ValueError:  # out of reach
            continue
    for change in TRUTH:
        yield change, one_check(change, scenario, config, calibration, X, T, rng, turned)


def one_check(change: str, scenario: Scenario, config: Config, calibration: Calibration,
              X: Array, T: Array, rng: np.random.Generator, turned: int = 0) -> Check:
    """Return what is said after a change."""
    way = np.array([0, 0, 3e-4, *np.deg2rad(0.05) * _direction(rng)])
    off = np.append(3e-4 * _direction(rng), np.deg2rad(0.1) * _direction(rng))
    T = T @ se3.perturb(np.eye(4), way) if change == 'target' else T
    X = se3.perturb(X, off) if change == 'sensor' else X
    joint = np.deg2rad(float(change.split()[1])) if 'joint' in change else 0.0
    return check(samples(scenario, STOPS, X, T, rng, joint, turned), calibration, config)


def _direction(rng: np.random.Generator) -> Array:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--first', type=int, default=0)
    parser.add_argument('--turned', type=int, default=0)
    parser.add_argument('seeds', type=int, nargs='?', default=20)
    parser.add_argument('targets', nargs='*', default=list(TARGETS))
    given = parser.parse_args()
    print(f'{"":7} {"change":10}  right  alone  missed  verdicts')
    for kind in given.targets:
        found: dict[str, Counter[str]] = {change: Counter() for change in TRUTH}
        for seed in range(given.first, given.first + given.seeds):
            for change, said in trials(kind, seed, given.turned):
                found[change][said.verdict] += 1
        for change, verdicts in found.items():
            cause = TRUTH[change]
            right = sum(n for v, n in verdicts.items() if cause in v.split(' or '))
            print(f'{kind:7} {change:10} {right / given.seeds:6.0%} '
                  f'{verdicts[cause] / given.seeds:6.0%} '
                  f'{verdicts["unchanged"] / given.seeds:7.0%}  {dict(verdicts)}', flush=True)


if __name__ == '__main__':
    main()
