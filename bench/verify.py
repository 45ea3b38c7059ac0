# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What `handeye verify` and `handeye check` say, over seeds.

usage: .venv/bin/python bench/verify.py [--rendered] [--stops] [--first SEED] [SEEDS] [ROUTINE...]
       .venv/bin/python bench/verify.py --check [--first SEED] [--turned N] [SEEDS] [TARGET...]

For each of SEEDS (default 200) a calibration is drawn with its stated covariance (0.03 mm and
0.01 degrees, 1 sigma of each axis) and measures a simulated artefact with the robot and sensor of
the main job. --rendered: from recordings of rendered profiles (640 columns, 10 Hz) and not from
features with exactly known noise. "within": how often the values lie within their stated 95 %
region (for lines and planes: the RMS distance below its stated 95 % bound). "wrong fails": how
often a calibration that is 1 mm and 0.5 degrees off fails at the default tolerance; the verdicts
of the right one follow. --stops: instead of all this, how many stops with which turns are needed
for faces: the smallest error of the calibration that would show, which 9 of 10 seeds stay below,
and how often an exact calibration passes at 0.3 mm.

--check: for each of SEEDS (20 are enough) a simulated cell (sensor 0.03 mm, robot 0.02 mm and
0.004 degrees) is calibrated from 18 stops; then the same target is seen from other stops, with
nothing changed, with the target moved (0.3 mm along the normal of its face and 0.05 degrees),
with the sensor moved on the flange (0.3 mm and 0.1 degrees), and with joint 5 of a six-axis arm
off by 0.05 and by 0.2 degrees. "right": the cause is named, alone or with others that the stops
cannot tell from it; "alone": and no other; "missed": nothing seems to have changed. --turned: so
many of the stops are repeated with the sensor turned by 90 degrees about its z, as a check asks
for.
"""
from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import product

from handeye_ros import pipeline, se3
from handeye_ros.config import Config, NoiseConfig, VerifyConfig, with_values
from handeye_ros.data import Array, Calibration, Quality, Sample
from handeye_ros.sampling.trajectory import track_of
from handeye_ros.simulate import arm, gauges
from handeye_ros.simulate.measuring import Pass, rendered
from handeye_ros.simulate.scenario import (
    PlateTarget,
    RobotModel,
    Scenario,
    SensorModel,
    SphereTarget,
)
from handeye_ros.simulate.scenarios import SCENARIOS
from handeye_ros.simulate.scenes import SCENES as TARGET_SCENES
from handeye_ros.simulate.stations import Stops
from handeye_ros.verification.check import Check, check
from handeye_ros.verification.fit import StationSet
from handeye_ros.verification.routines import Routine, ROUTINES, settings_for, TEETH
from handeye_ros.verification.stations import stations_of, stations_of_pass
from handeye_ros.verification.verify import Verification, verify
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

STD = np.repeat([3e-5, np.deg2rad(0.01)], 3)
ROBOT = RobotModel()
NOISE = NoiseConfig(sensor=SensorModel().noise, robot_translation=ROBOT.repeatability[0],
                    robot_rotation=ROBOT.repeatability[1])
SCENES = {'line': gauges.line, 'plane': gauges.plane, 'point': gauges.fixed_point,
          'sphere': gauges.sphere, 'ball_bar': gauges.ball_bar, 'step': gauges.step_block,
          'square': gauges.square, 'tooth': gauges.tooth}
RADIUS = 0.02
STOPS = 8  # of a check
TARGETS = {'plate': PlateTarget(table=None), 'plane': PlateTarget(table=None),
           'line': PlateTarget(table=None), 'sphere': SphereTarget(0.02, None, False),
           'wedge': SCENARIOS['wedge'].target}
TRUTH = {'unchanged': 'unchanged', 'target': 'target', 'sensor': 'sensor', 'joint 0.05': 'robot',
         'joint 0.2': 'robot'}
FINE_AIM = 1e-5  # m: as the corner of a real plate is found inside of it by 0.8 times the aim


def take(scenario: Scenario, X: Array, T: Array, stops: Stops, rng: np.random.Generator) -> Pass:
    """Return a recording with fewer columns, profiles and poses, to be quick."""
    sensor = replace(scenario.sensor, columns=640, rate=10.0)
    robot = replace(scenario.robot, rate=50.0)
    return rendered(replace(scenario, sensor=sensor, robot=robot), X, T, stops, rng)


RENDERED = SCENES | {name: partial(scene, take=take) for name, scene in SCENES.items()
                     if name != 'tooth'}  # which is rendered anyway
RENDERED['point'] = partial(RENDERED['point'], aim=FINE_AIM)


def calibration(X: Array, covariance: Array) -> Calibration:
    return Calibration('bench', 'plate', 'flange', 'laser', X, covariance, {},
                       Quality(0, 0, 0.0, 0.0, '', 0.0), ())


def covariance(rng: np.random.Generator) -> Array:
    """Return a covariance with correlations, as calibrations have."""
    mixing = np.eye(6) + 0.3 * rng.normal(size=(6, 6))
    C = mixing @ mixing.T
    size = STD / np.sqrt(np.diag(C))
    return np.asarray(C * np.outer(size, size))


def scanned(made: gauges.Measured, config: Config) -> list[StationSet]:
    """Return what a scan in passes gives the routine of the gauge."""
    return [stations_of_pass(part.profiles, track_of(part.poses, 0.5), config)
            for part in made.passes]


def stops_of(routine: Routine, made: gauges.Measured, config: Config
             ) -> list[tuple[Sample, ...]]:
    """Return the samples of each bag, where the robot stops."""
    if not made.passes:
        return list(made.bags)
    settings = settings_for(routine, config, len(made.passes))
    return [pipeline.gather(part.profiles, part.poses, settings).samples for part in made.passes]


def runs(routine: Routine, made: gauges.Measured, found: tuple[Calibration, ...], aim: float
         ) -> list[Verification]:
    """Return what a routine says of calibrations."""
    radius = RADIUS if routine.target == 'sphere' else 0.0
    config = Config(noise=NOISE, verify=VerifyConfig(
        lengths=made.lengths, radius=radius, reference=made.reference, aim=aim))
    if routine.target == TEETH:
        bags = scanned(made, config)
        return [verify(routine, bags, one, config) for one in found]
    bags = stops_of(routine, made, config)
    return [verify(routine, [stations_of(routine, samples, one, config) for samples in bags], one,
                   config) for one in found]


def within(found: Verification) -> bool:
    if not found.freedom:
        return found.scatter.rms <= found.scatter.expected
    return bool(found.region <= chi2.ppf(0.95, found.freedom))


def trial(name: str, seed: int, scenes: dict = SCENES) -> tuple[Verification, Verification]:
    """Return what a routine says of a right calibration, and of a wrong one."""
    rng = np.random.default_rng(seed)
    made, C = scenes[name](rng), covariance(rng)
    X = se3.perturb(made.T_flange_sensor, np.linalg.cholesky(C) @ rng.normal(size=6))
    directions = rng.normal(size=(2, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    off = np.concatenate([1e-3 * directions[0], np.deg2rad(0.5) * directions[1]])
    aim = 0.0 if name != 'point' else FINE_AIM if scenes is RENDERED else gauges.AIM
    right, wrong = runs(ROUTINES[name], made, (
        calibration(X, C), calibration(se3.perturb(X, off), C)), aim)
    return right, wrong


def stops(names: list[str], seeds: range) -> None:
    """Print what is seen from so many stops with such turns."""
    print(f'{"":9} stops  turns  smallest error [mm]  exact passes')
    for name in [name for name in names if name in ('plane', 'step', 'square')]:
        for count, tilt in product((8, 12, 20, 30), (20, 30, 40)):
            found = []
            for seed in seeds:
                made = SCENES[name](np.random.default_rng(seed), count=count,
                                    tilt=np.deg2rad(tilt))
                exact = calibration(made.T_flange_sensor, np.diag(STD ** 2))
                found += runs(ROUTINES[name], made, (exact,), 0.0)
            size = np.quantile([v.smallest_error for v in found], 0.9)
            passed = np.mean([v.verdict == 'pass' for v in found])
            print(f'{name:9} {count:5} {tilt:6} {1e3 * size:20.2f} {passed:13.0%}', flush=True)


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
    stops = with_turned(TARGET_SCENES[scenario.scene].stops(scenario, rng), turned)
    found = gauges.stations(scenario, X, T, stops, rng)
    if not joint:
        return list(found)
    offsets = np.array([0, 0, 0, 0, joint, 0.0])
    errors = arm.ArmErrors(np.zeros((6, 6)), offsets, np.zeros(6), np.zeros(6))
    poses = np.array([s.T_base_flange for s in found])
    reported = se3.perturb(poses, arm.reported_error(poses, errors))
    return [replace(s, T_base_flange=one) for s, one in zip(found, reported, strict=True)]


def checks(kind: str, seed: int, turned: int = 0) -> Iterator[tuple[str, Check]]:
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


def check_all(kinds: list[str], seeds: range, turned: int) -> None:
    """Print what is said after each change."""
    print(f'{"":7} {"change":10}  right  alone  missed  verdicts')
    for kind in kinds:
        found: dict[str, Counter[str]] = {change: Counter() for change in TRUTH}
        for seed in seeds:
            for change, said in checks(kind, seed, turned):
                found[change][said.verdict] += 1
        for change, verdicts in found.items():
            cause = TRUTH[change]
            right = sum(n for v, n in verdicts.items() if cause in v.split(' or '))
            print(f'{kind:7} {change:10} {right / len(seeds):6.0%} '
                  f'{verdicts[cause] / len(seeds):6.0%} '
                  f'{verdicts["unchanged"] / len(seeds):7.0%}  {dict(verdicts)}', flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--rendered', action='store_true')
    parser.add_argument('--stops', action='store_true')
    parser.add_argument('--check', action='store_true')
    parser.add_argument('--turned', type=int, default=0)
    parser.add_argument('--first', type=int, default=0)
    parser.add_argument('seeds', type=int, nargs='?', default=200)
    parser.add_argument('names', nargs='*')
    given = parser.parse_args()
    seeds = range(given.first, given.first + given.seeds)
    if given.check:
        check_all(given.names or list(TARGETS), seeds, given.turned)
        return
    routines = given.names or list(SCENES)
    if given.stops:
        stops(routines, seeds)
        return
    print(f'{"":9} within  wrong fails  smallest_error [mm]  verdicts of the right calibration')
    for name in routines:
        trials = [trial(name, seed, RENDERED if given.rendered else SCENES) for seed in seeds]
        inside = np.mean([within(right) for right, _ in trials])
        failed = np.mean([wrong.verdict == 'fail' for _, wrong in trials])
        smallest_error = np.median([right.smallest_error for right, _ in trials])
        verdicts = Counter(right.verdict for right, _ in trials)
        result = ', '.join(f'{count} {verdict}' for verdict, count in verdicts.most_common())
        print(f'{name:9} {inside:6.1%} {failed:11.1%} {1e3 * smallest_error:13.3f}  {result}',
              flush=True)


if __name__ == '__main__':
    main()
