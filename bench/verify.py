# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Every verification routine over seeds: are its regions honest, and does it see a wrong calibration.

usage: .venv/bin/python bench/verify.py [--rendered] [--stops] [--first SEED] [SEEDS] [ROUTINE...]

For each of SEEDS (default 200) a calibration is drawn with its stated covariance (0.03 mm and
0.01 degrees, 1 sigma of each axis) and measures a simulated artefact with the robot and sensor of
the main job. --rendered: from recordings of rendered profiles (640 columns, 10 Hz) and not from
features with exactly known noise. "within": how often the values lie within their stated 95 %
region (for lines and planes: the RMS distance below its stated 95 % bound). "wrong fails": how
often a calibration that is 1 mm and 0.5 degrees off fails at the default tolerance; the verdicts
of the right one follow. --stops: instead of all this, how many stops with which turns are needed
for faces: the smallest error of the calibration that would show, which 9 of 10 seeds stay below,
and how often an exact calibration passes at 0.3 mm.
"""
from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
from functools import partial
from itertools import product

from handeye_ros import pipeline, se3
from handeye_ros.config import Config, NoiseConfig, VerifyConfig
from handeye_ros.data import Array, Calibration, Quality, Sample
from handeye_ros.sampling.trajectory import track_of
from handeye_ros.simulate import gauges
from handeye_ros.simulate.measuring import Pass, rendered
from handeye_ros.simulate.scenario import RobotModel, Scenario, SensorModel
from handeye_ros.simulate.stations import Stops
from handeye_ros.verification.decision import Verification
from handeye_ros.verification.routines import Routine, ROUTINES, settings_for, TEETH
from handeye_ros.verification.shapes import StationSet
from handeye_ros.verification.stations import stations_of
from handeye_ros.verification.tooth_gauge import stations_of_pass
from handeye_ros.verification.verify import verify
import numpy as np
from scipy.stats import chi2

STD = np.repeat([3e-5, np.deg2rad(0.01)], 3)
ROBOT = RobotModel()
NOISE = NoiseConfig(sensor=SensorModel().noise, robot_translation=ROBOT.repeatability[0],
                    robot_rotation=ROBOT.repeatability[1])
SCENES = {'line': gauges.line, 'plane': gauges.plane, 'point': gauges.fixed_point,
          'sphere': gauges.sphere, 'ball_bar': gauges.ball_bar, 'step': gauges.step_block,
          'square': gauges.square, 'tooth': gauges.tooth}
RADIUS = 0.02
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--rendered', action='store_true')
    parser.add_argument('--stops', action='store_true')
    parser.add_argument('--first', type=int, default=0)
    parser.add_argument('seeds', type=int, nargs='?', default=200)
    parser.add_argument('routines', nargs='*', default=list(SCENES))
    given = parser.parse_args()
    if given.stops:
        stops(given.routines, range(given.first, given.first + given.seeds))
        return
    print(f'{"":9} within  wrong fails  smallest_error [mm]  verdicts of the right calibration')
    for name in given.routines:
        trials = [trial(name, given.first + k, RENDERED if given.rendered else SCENES)
                  for k in range(given.seeds)]
        inside = np.mean([within(right) for right, _ in trials])
        failed = np.mean([wrong.verdict == 'fail' for _, wrong in trials])
        smallest_error = np.median([right.smallest_error for right, _ in trials])
        verdicts = Counter(right.verdict for right, _ in trials)
        result = ', '.join(f'{count} {verdict}' for verdict, count in verdicts.most_common())
        print(f'{name:9} {inside:6.1%} {failed:11.1%} {1e3 * smallest_error:13.3f}  {result}',
              flush=True)


if __name__ == '__main__':
    main()
