# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What `handeye verify` and `handeye check` say, over seeds.

usage: .venv/bin/python bench/verify.py [--rendered] [--first SEED] [SEEDS] [ROUTINE...]
       .venv/bin/python bench/verify.py --check [--first SEED] [SEEDS] [TARGET...]
       .venv/bin/python bench/verify.py --unchanged [--first SEED] [SEEDS] [FAULT...]

For each of SEEDS (default 200) a calibration is drawn with its stated covariance (0.03 mm and
0.01 degrees, 1 sigma of each axis) and measures a simulated artefact with the robot and sensor of
the main job. --rendered: from recordings of rendered profiles (640 columns, 10 Hz) and not from
features with exactly known noise. "within": how often the values lie within their stated 95 %
region (for lines and planes: the RMS distance below its stated 95 % bound). "wrong fails": how
often a calibration that is 1 mm and 0.5 degrees off fails at the default tolerance. "shown": how
often one that is off by just the stated smallest error, in the direction in which it shows least,
is noticed with this size as tolerance. The verdicts of the right one follow.

--check: for each of SEEDS (20 are enough) a simulated cell (sensor 0.03 mm, robot 0.02 mm and
0.004 degrees) is calibrated from 18 stops; then the same target is seen from other stops, with
nothing changed, with the target moved (0.3 mm along the normal of its face and 0.05 degrees),
with the sensor moved on the flange (0.3 mm and 0.1 degrees), and with joint 5 of a six-axis arm
off by 0.05 and by 0.2 degrees. "right": the cause is named, alone or with others that the stops
cannot tell from it; "alone": and no other; "missed": nothing seems to have changed.

--unchanged: recordings of the cells of bench/physics.py with twice as many stops, of which every
second calibrates and the others check: what is said of a cell that is as it was, whatever its
faults are. FAULT: a part of its name.

An artefact is some targets at known poses in one frame: each gives a bag, by one sensor and robot.
"""
from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

from handeye_ros import pipeline, se3
from handeye_ros.config import Config, NoiseConfig, VerifyConfig, with_values
from handeye_ros.data import Array, Calibration, EdgePoint, FaceLine, Quality, Sample
from handeye_ros.errors import DataError
from handeye_ros.sampling.trajectory import trajectory_of
from handeye_ros.simulate import FAULTS, settings, simulate
from handeye_ros.simulate import robot as robots
from handeye_ros.simulate.artefacts import (
    draw_pose,
    Gauge,
    Messages,
    messages_at_stops,
    scan_gauge,
)
from handeye_ros.simulate.robot import pose_error
from handeye_ros.simulate.scenario import (
    PlateTarget,
    RobotModel,
    Scenario,
    SCENARIOS,
    SensorModel,
    SphereTarget,
)
from handeye_ros.simulate.scenes import Placements, tilts
from handeye_ros.simulate.scenes import SCENES as TARGET_SCENES
from handeye_ros.simulate.sensor import lift
from handeye_ros.verification.check import CalibratedCell, Check, check
from handeye_ros.verification.fit import SIGNIFICANCE
from handeye_ros.verification.routines import Routine, ROUTINES
from handeye_ros.verification.station_set import StationSet
from handeye_ros.verification.stations import stations_of, stations_of_passes
from handeye_ros.verification.verify import Verification, verify_stations
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

TILT = np.deg2rad(40)  # of the sensor over faces
PLAIN = SensorModel(columns=320, rate=5.0, rim_bias=0.0, mixed=0.0, lost=0.0, lost_at_edge=0.0,
                    outliers=0.0)
AIM = 5e-5  # m: 1 sigma of the aim of the laser at a point
INTO_CORNER = np.array([[1, 1, 0], [1, -1, 0], [0, 0, -2 ** 0.5]]).T / 2 ** 0.5  # T_target_sensor

Taken: TypeAlias = tuple[Sample, ...] | Messages
Take: TypeAlias = Callable[[Scenario, Array, Array, Placements, np.random.Generator], Taken]


@dataclass(frozen=True, eq=False)
class Artefact:
    """
    What is seen of an artefact: the samples of each bag; T_flange_sensor (4, 4), true values.

    lengths: of the ball bar, heights of the steps, or pitch and height of the teeth; reference:
    the true point (3,) in the base; passes: recordings, where there are no samples.
    """

    bags: tuple[tuple[Sample, ...], ...]
    T_flange_sensor: Array
    lengths: tuple[float, ...] = ()
    reference: tuple[float, ...] = ()
    passes: tuple[Messages, ...] = ()


def sensor_on_flange(rng: np.random.Generator) -> Array:
    """Draw the pose of the sensor on the flange (4, 4)."""
    return se3.transform(Rotation.random(random_state=rng).as_matrix(),
                         rng.uniform(-0.12, 0.12, 3))


# -- how stops at a fixed target are taken: samples, or recordings


def reported_poses(scenario: Scenario, T_flange_sensor: Array, T_base_target: Array,
                   stops: Placements, rng: np.random.Generator) -> Array:
    """Return the reported poses (n, 4, 4) of the flange at stops."""
    T = T_base_target @ stops.T_target_sensor @ se3.inverse(T_flange_sensor)
    return se3.perturb(T, pose_error(scenario.robot, T, rng))


def sampled(scenario: Scenario, T_flange_sensor: Array, T_base_target: Array, stops: Placements,
            rng: np.random.Generator) -> tuple[Sample, ...]:
    """Return the samples of stops."""
    features = TARGET_SCENES[scenario.scene].features(scenario, stops, rng)
    T = reported_poses(scenario, T_flange_sensor, T_base_target, stops, rng)
    return tuple(Sample(k * 2_000_000_000, T_k, f, scenario.profiles_per_stop)
                 for k, (T_k, f) in enumerate(zip(T, features, strict=True)))


def sampled_corner(scenario: Scenario, T_flange_sensor: Array, T_base_target: Array,
                   stops: Placements, rng: np.random.Generator) -> tuple[Sample, ...]:
    """Return the samples of stops with the corner of a plate as edge point."""
    T = reported_poses(scenario, T_flange_sensor, T_base_target, stops, rng)
    std = float(scenario.sensor.noise / np.sqrt(scenario.profiles_per_stop))
    along, samples = np.array([1.0, 0.0]), []
    for k, (pose, seen) in enumerate(zip(T, stops.points, strict=True)):
        edge = EdgePoint(seen + rng.normal(size=2) * std, along, std, std)
        samples.append(Sample(k * 2_000_000_000, pose, (
            FaceLine(seen - [5e-3, 0], along, 3e-3, std), edge)))
    return tuple(samples)


# -- artefacts


def artefact(rng: np.random.Generator, scene: str, poses: Array, lengths: tuple[float, ...] = (),
             count: int = 14, take: Take = sampled, **changes: Any) -> Artefact:
    """
    Return bags of so many stops at targets of a scene at poses (k, 4, 4) in the artefact.

    changes: of the scenario.
    """
    scenario = replace(SCENARIOS[scene], stops=(count, 0), **{'robot': RobotModel()} | changes)
    X, T = sensor_on_flange(rng), draw_pose(rng)
    taken = [take(scenario, X, T @ pose, TARGET_SCENES[scene].placements(scenario, rng), rng)
             for pose in poses]
    return _taken(taken, X, lengths)


def _taken(taken: list[Taken], X: Array, lengths: tuple[float, ...] = (),
           reference: tuple[float, ...] = ()) -> Artefact:
    return Artefact(tuple(bag for bag in taken if not isinstance(bag, Messages)), X, lengths,
                    reference, tuple(bag for bag in taken if isinstance(bag, Messages)))


def _poses(count: int) -> Array:
    return np.repeat(np.eye(4)[None], count, axis=0)


def line(rng: np.random.Generator, **values: Any) -> Artefact:
    """Return a straight edge."""
    return artefact(rng, 'line', _poses(1), **values)


def faces(rng: np.random.Generator, poses: Array, lengths: tuple[float, ...] = (), **values: Any
          ) -> Artefact:
    """Return flat faces at poses (k, 4, 4) in the artefact."""
    return artefact(rng, 'plane', poses, lengths, **{
        'count': 20, 'target': PlateTarget(table=None), 'tilt': TILT} | values)


def plane(rng: np.random.Generator, **values: Any) -> Artefact:
    """Return a flat face."""
    return faces(rng, _poses(1), **values)


LAID = np.array([[0, 0, 0], [0, np.pi / 2, 0], [0, 0, np.pi / 2]])  # zyx: along z, x, y


def step_block(rng: np.random.Generator, heights: tuple[float, ...] = (0.025, 0.05, 0.1),
               **values: Any) -> Artefact:
    """Return parallel faces at several heights, orthogonal to x, y or z of the base."""
    poses, turn = _poses(1 + len(heights)), np.eye(4)
    poses[1:, 2, 3] = heights
    turn[:3, :3] = Rotation.from_euler('zyx', LAID[int(rng.integers(3))]).as_matrix()
    return faces(rng, turn @ poses, heights, **values)


def square(rng: np.random.Generator, **values: Any) -> Artefact:
    """Return two faces at a right angle."""
    poses = _poses(2)
    poses[1, :3, :3] = Rotation.from_euler('x', np.pi / 2).as_matrix()
    poses[1, :3, 3] = [0, 0.15, 0]
    return faces(rng, poses, **values)


def ball_bar(rng: np.random.Generator, balls: int = 2, length: float = 0.2, radius: float = 0.02,
             **values: Any) -> Artefact:
    """Return balls in a row (one: a sphere)."""
    poses = _poses(balls)
    poses[:, 0, 3] = np.arange(balls) * length
    return artefact(rng, 'sphere', poses, (length,) * (balls - 1), **{
        'target': SphereTarget(radius, table=None, clutter=False)} | values)


def sphere(rng: np.random.Generator, **values: Any) -> Artefact:
    """Return one ball."""
    return ball_bar(rng, balls=1, **values)


def fixed_point(rng: np.random.Generator, count: int = 12, aim: float = AIM,
                take: Take = sampled_corner, **changes: Any) -> Artefact:
    """Return the corner of a plate, to which the laser is aimed with some error."""
    scenario = replace(SCENARIOS['line'], stops=(count, 0), **{'robot': RobotModel()} | changes)
    X, T = sensor_on_flange(rng), draw_pose(rng)
    points = TARGET_SCENES['line'].placements(scenario, rng).points
    R = INTO_CORNER @ tilts(scenario, rng, (count,))
    aim_error = aim * rng.normal(size=(count, 3))
    position = aim_error - (R @ lift(points)[:, :, None])[:, :, 0]
    stops = Placements(se3.transform(R, position), ('p',) * count, points)
    return _taken([take(scenario, X, T, stops, rng)], X, reference=tuple(
        map(float, T[:3, 3])))


def tooth(rng: np.random.Generator, sensor: SensorModel = PLAIN, robot: RobotModel | None = None
          ) -> Artefact:
    """Return a scanned gauge of teeth; sensor: by default without faults other than noise."""
    gauge, X = Gauge(), sensor_on_flange(rng)
    passes = scan_gauge(gauge, X, draw_pose(rng), sensor, robot or RobotModel(), rng)
    return Artefact((), X, (gauge.pitch, gauge.height), passes=passes)


# -- verify


STD = np.repeat([3e-5, np.deg2rad(0.01)], 3)
ROBOT = RobotModel()
NOISE = NoiseConfig(sensor=SensorModel().noise, robot_translation=ROBOT.repeatability[0],
                    robot_rotation=ROBOT.repeatability[1])
SCENES = {'line': line, 'plane': plane, 'point': fixed_point, 'sphere': sphere,
          'ball_bar': ball_bar, 'step': step_block, 'square': square, 'tooth': tooth}
RADIUS = 0.02
STOPS = 8  # of a check
TARGETS = {'plate': PlateTarget(table=None), 'plane': PlateTarget(table=None),
           'line': PlateTarget(table=None), 'sphere': SphereTarget(0.02, None, False),
           'wedge': SCENARIOS['wedge'].target}
TRUTH = {'unchanged': 'unchanged', 'target': 'target', 'sensor': 'sensor', 'joint 0.05': 'robot',
         'joint 0.2': 'robot'}
FINE_AIM = 1e-5  # m: as the corner of a real plate is found inside of it by 0.8 times the aim


def take(scenario: Scenario, X: Array, T: Array, stops: Placements, rng: np.random.Generator
         ) -> Messages:
    """Return a recording with fewer columns, profiles and poses, to be quick."""
    sensor = replace(scenario.sensor, columns=640, rate=10.0)
    robot = replace(scenario.robot, rate=50.0)
    return messages_at_stops(replace(scenario, sensor=sensor, robot=robot), X, T, stops, rng)


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


def scanned(made: Artefact, found: Calibration, config: Config) -> StationSet:
    """Return what a scan in passes gives the routine of the gauge."""
    return stations_of_passes([(part.profiles, trajectory_of(part.poses, 0.5))
                               for part in made.passes], found, config)


def stops_of(routine: Routine, made: Artefact, config: Config
             ) -> list[tuple[Sample, ...]]:
    """Return the samples of each bag, where the robot stops."""
    if not made.passes:
        return list(made.bags)
    settings = routine.settings(config, len(made.passes))
    return [pipeline.gather(part.profiles, part.poses, settings).samples for part in made.passes]


def runs(routine: Routine, made: Artefact, found: tuple[Calibration, ...], aim: float,
         tolerance: float = VerifyConfig.tolerance) -> list[Verification]:
    """Return what a routine says of calibrations."""
    radius = RADIUS if routine.target == 'sphere' else 0.0
    config = Config(noise=NOISE, verify=VerifyConfig(
        lengths=made.lengths, radius=radius, reference=made.reference, aim=aim,
        tolerance=tolerance))
    if routine.in_passes:
        return [verify_stations(routine, scanned(made, one, config), one) for one in found]
    bags = stops_of(routine, made, config)
    return [verify_stations(routine, stations_of(routine, bags, one, config), one)
            for one in found]


def within(found: Verification) -> bool:
    if not found.fit.degrees_of_freedom:
        return found.fit.scatter.p > 0.05
    return bool(found.fit.chi2 <= chi2.ppf(0.95, found.fit.degrees_of_freedom))


def trial(name: str, seed: int, scenes: dict = SCENES) -> tuple[Verification, Verification]:
    """Return what a routine says of a right calibration, and of a wrong one."""
    rng = np.random.default_rng(seed)
    made, C = scenes[name](rng), covariance(rng)
    X = se3.perturb(made.T_flange_sensor, np.linalg.cholesky(C) @ rng.normal(size=6))
    directions = rng.normal(size=(2, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    off = np.concatenate([1e-3 * directions[0], np.deg2rad(0.5) * directions[1]])
    right, wrong = runs(ROUTINES[name], made, (
        calibration(X, C), calibration(se3.perturb(X, off), C)), aim_of(name, scenes))
    return right, wrong


def shown(name: str, seed: int, scenes: dict = SCENES) -> bool:
    """Return whether a routine finds an error of just the smallest size that it states."""
    rng = np.random.default_rng(seed)
    made, C, aim = scenes[name](rng), covariance(rng), aim_of(name, scenes)
    true, = runs(ROUTINES[name], made, (calibration(made.T_flange_sensor, C),), aim)
    error = true.fit.misalignment
    try:
        off, = runs(ROUTINES[name], made, (calibration(
            se3.perturb(made.T_flange_sensor, error.weakest), C),), aim, error.smallest_detectable)
    except DataError:  # no small error explains the points
        return True
    return off.fit.misalignment.p_chance <= SIGNIFICANCE


def aim_of(name: str, scenes: dict) -> float:
    """Return 1 sigma of the aim (m)."""
    return 0.0 if name != 'point' else FINE_AIM if scenes is RENDERED else AIM


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


def samples(scenario: Scenario, count: int, X: Array, T: Array, rng: np.random.Generator,
            joint: float = 0.0) -> list[Sample]:
    """Return the samples of some stops; joint: by how much joint 5 is off (rad)."""
    scenario = replace(scenario, stops=((count + 1) // 2, count // 2) if
                       scenario.scene == 'plate' else (count, 0))
    stops = TARGET_SCENES[scenario.scene].placements(scenario, rng)
    found = sampled(scenario, X, T, stops, rng)
    if not joint:
        return list(found)
    offsets = np.array([0, 0, 0, 0, joint, 0.0])
    errors = robots.ArmErrors(np.zeros((6, 6)), offsets, np.zeros(6), np.zeros(6))
    poses = np.array([s.T_base_flange for s in found])
    reported = se3.perturb(poses, robots.arm_pose_error(poses, errors))
    return [replace(s, T_base_flange=one) for s, one in zip(found, reported, strict=True)]


def checks(kind: str, seed: int) -> Iterator[tuple[str, Check]]:
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
        yield change, one_check(change, scenario, config, calibration, X, T, rng)


def one_check(change: str, scenario: Scenario, config: Config, calibration: Calibration,
              X: Array, T: Array, rng: np.random.Generator) -> Check:
    """Return what is said after a change."""
    way = np.array([0, 0, 3e-4, *np.deg2rad(0.05) * _direction(rng)])
    off = np.append(3e-4 * _direction(rng), np.deg2rad(0.1) * _direction(rng))
    T = T @ se3.perturb(np.eye(4), way) if change == 'target' else T
    X = se3.perturb(X, off) if change == 'sensor' else X
    joint = np.deg2rad(float(change.split()[1])) if 'joint' in change else 0.0
    return check(samples(scenario, STOPS, X, T, rng, joint),
                 CalibratedCell.of_calibration(calibration, config))


def _direction(rng: np.random.Generator) -> Array:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def check_all(kinds: list[str], seeds: range) -> None:
    """Print what is said after each change."""
    print(f'{"":7} {"change":10}  right  alone  missed  verdicts')
    for kind in kinds:
        found: dict[str, Counter[str]] = {change: Counter() for change in TRUTH}
        for seed in seeds:
            for change, said in checks(kind, seed):
                found[change][said.verdict] += 1
        for change, verdicts in found.items():
            cause = TRUTH[change]
            right = sum(n for v, n in verdicts.items() if cause in v.split(' or '))
            print(f'{kind:7} {change:10} {right / len(seeds):6.0%} '
                  f'{verdicts[cause] / len(seeds):6.0%} '
                  f'{verdicts["unchanged"] / len(seeds):7.0%}  {dict(verdicts)}', flush=True)


def unchanged_cells(faults: list[str], seeds: range) -> None:
    """Print what is said of cells that are as they were when half of the stops calibrated."""
    for name in (name for name in FAULTS if any(fault in name for fault in faults)):
        verdicts = Counter(verdict_of_halves(FAULTS[name], seed) for seed in seeds)
        print(f'{name:32} {dict(verdicts.most_common())}', flush=True)


def verdict_of_halves(scenario: Scenario, seed: int) -> str:
    """Return what the second half of a recording's stops says of the first half's calibration."""
    first, second = scenario.stops
    recording = simulate(replace(scenario, stops=(2 * first, 2 * second)),
                         np.random.default_rng(seed))
    config = with_values(Config(), settings(scenario))
    samples = pipeline.gather(recording.profiles, recording.poses, config).samples
    try:
        calibration = pipeline.solve(samples[::2], [], config, 'laser')
        return check(samples[1::2], CalibratedCell.of_calibration(calibration, config)).verdict
    except DataError:
        return 'refused'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--rendered', action='store_true')
    parser.add_argument('--check', action='store_true')
    parser.add_argument('--unchanged', action='store_true')
    parser.add_argument('--first', type=int, default=0)
    parser.add_argument('seeds', type=int, nargs='?', default=200)
    parser.add_argument('names', nargs='*')
    given = parser.parse_args()
    seeds = range(given.first, given.first + given.seeds)
    if given.check:
        check_all(given.names or list(TARGETS), seeds)
        return
    if given.unchanged:
        unchanged_cells(given.names or [''], seeds)
        return
    routines = given.names or list(SCENES)
    print(f'{"":9} within  wrong fails  smallest_error [mm]  shown  '
          'verdicts of the right calibration')
    for name in routines:
        scenes = RENDERED if given.rendered else SCENES
        trials = [trial(name, seed, scenes) for seed in seeds]
        found = np.mean([shown(name, seed, scenes) for seed in seeds])
        inside = np.mean([within(right) for right, _ in trials])
        failed = np.mean([wrong.verdict == 'fail' for _, wrong in trials])
        smallest_error = np.median([
            right.fit.misalignment.smallest_detectable for right, _ in trials])
        verdicts = Counter(right.verdict for right, _ in trials)
        result = ', '.join(f'{count} {verdict}' for verdict, count in verdicts.most_common())
        print(f'{name:9} {inside:6.1%} {failed:11.1%} {1e3 * smallest_error:13.3f} {found:13.1%}  '
              f'{result}', flush=True)


if __name__ == '__main__':
    main()
