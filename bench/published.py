#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Our estimators beside the published ones where no profile of a flange is involved.

usage: python bench/published.py [--trials N] [--seed S] [--only TEXT] [--brief]

Points in two frames (Wu 2017), A X = X B (CN105021139A, and OpenCV where it is installed) in
cells of different noise, the laser tracker (Jing 2020). All get the same simulated measurements.
A row per estimator: medians of error (translation, rotation, points mapped from where the sensor
works; and its worst); then each median over ours, with its 95 % interval (see bench/paired.py).
--brief: a line per cell, our medians and the nearest published one in each quantity.
"Noise known": ours, told the noise that it else finds out from the residuals. For the targets
that a profiler on the flange sees: bench/compare.py.
"""
from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.config import Config, with_values
from handeye_ros.published import cn105021139a, jing2020, wu2017
from handeye_ros.simulate.measured import RADIUS, SENSOR, simulate_tracker
from handeye_ros.tabulated.hand_eye import Views
from handeye_ros.tabulated.points import Pairs
from handeye_ros.tabulated.sweeps import sweep_from, SWEPT
import numpy as np
from paired import errors, grid, print_header, print_nearest, print_table
from scipy.spatial.transform import Rotation

try:
    import cv2
except ModuleNotFoundError:
    cv2 = None

OPENCV = ('TSAI', 'PARK', 'HORAUD', 'ANDREFF', 'DANIILIDIS')
NO_ANSWER = np.full((4, 4), np.nan)
OURS = ('A X = X B, noise known',)
LIMITS = (0.07, 0.25)  # of e_theta (degrees) and e_p (mm)

Answers = Iterator[tuple[str, np.ndarray]]


@dataclass(frozen=True)
class Trial:
    """The truth (4, 4), points (n, 3) of the sensor frame to map, the answers one by one."""

    T_true: np.ndarray
    points: np.ndarray
    answers: Answers


def two_frames(rng: np.random.Generator) -> Trial:
    """Return a trial with ten points, 0.03 mm per axis; they are mapped themselves."""
    T = se3.transform(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-1, 1, 3))
    base = rng.uniform(-0.15, 0.15, (10, 3))
    exact = se3.apply(se3.inverse(T), base)
    camera = exact + 3e-5 * rng.normal(size=(10, 3))

    def answers() -> Answers:
        yield 'points', Pairs(camera, base).solve(Config()).X
        yield 'Wu 2017, best of 210', wu2017.solve(camera, base).T_base_camera
    return Trial(T, exact, answers())


@dataclass(frozen=True)
class Poses:
    """
    A cell of A X = X B: 1 sigma per axis (m, rad) of camera and robot, views, tilts (degrees).

    on_base: the camera stands beside the robot, which carries the target.
    """

    camera: tuple[float, float] = (1e-4, 1e-3)
    robot: tuple[float, float] = (3e-5, 1e-4)
    count: int = 12
    tilts: tuple[float, float, float] = (30, 30, 60)
    on_base: bool = False

    def trial(self, rng: np.random.Generator) -> Trial:
        """Return a trial; mapped: x and y within +-50 mm, range 200-300 mm."""
        X = se3.transform(Rotation.random(random_state=rng).as_matrix(), 0.1 * rng.normal(size=3))
        Z = se3.transform(Rotation.random(random_state=rng).as_matrix(),
                          np.array([0.7, 0.1, 0.2]))
        turns = rng.uniform(-np.array(self.tilts), self.tilts, (self.count, 3))
        R = Rotation.from_euler('xyz', turns, degrees=True).as_matrix() @ np.diag([1.0, -1, -1])
        place = rng.uniform([-0.05, -0.05, 0.2], [0.05, 0.05, 0.3], (self.count, 3))
        views = se3.transform(R, place)
        if self.on_base:
            X, Z = Z, X
        T = Z @ se3.inverse(views) @ se3.inverse(X)
        T = off_by(se3.inverse(T) if self.on_base else T, *self.robot, rng)
        side = (-0.05, 0.0, 0.05)
        return Trial(X, grid(side, side, (0.2, 0.25, 0.3)),
                     self.answers(T, off_by(views, *self.camera, rng)))

    def answers(self, T: np.ndarray, views: np.ndarray) -> Answers:
        """Yield what each makes of the poses."""
        T = se3.inverse(T) if self.on_base else T
        poses = Views(T, views)
        config = with_values(Config(), {
            'calibration_type': 'eye_on_base' if self.on_base else 'eye_in_hand'}, 'cell')
        yield 'A X = X B', poses.solve(config).X
        (camera, camera_turn), (robot, robot_turn) = np.square([self.camera, self.robot])
        known, _ = poses.adjusted(poses.closed_form(), np.array(
            [camera + robot, camera_turn, robot_turn]), self.on_base)
        yield 'A X = X B, noise known', known.state[0]
        yield 'CN105021139A', cn105021139a.solve_motions(*cn105021139a.motions(T, views))
        for name in OPENCV if cv2 else ():
            try:
                R, t = cv2.calibrateHandEye(
                    T[:, :3, :3], T[:, :3, 3], views[:, :3, :3], views[:, :3, 3],
                    method=getattr(cv2, f'CALIB_HAND_EYE_{name}'))
            except cv2.error:
                R, t = np.full((3, 3), np.nan), np.full((3, 1), np.nan)
            yield f'OpenCV, {name.capitalize()}', se3.transform(R, t[:, 0])


def off_by(T: np.ndarray, shift: float, turn: float, rng: np.random.Generator) -> np.ndarray:
    """Return poses (n, 4, 4) with noise per axis (m, rad)."""
    e = rng.normal(size=(len(T), 6)) * np.repeat([shift, turn], 3)
    return se3.transform(se3.exp_rotation(e[:, 3:]) @ T[:, :3, :3], T[:, :3, 3] + e[:, :3])


def by_tracker(rng: np.random.Generator) -> Trial:
    """Return a trial of arm, ball and block; tracker 0.02 mm, sensor 0.037 mm."""
    cell = simulate_tracker(rng)
    config = with_values(Config(), {'noise.sensor': SENSOR.noise, 'target.radius': RADIUS,
                                    'tracker.first_reading': cell.q3_first}, 'cell')
    sweep = sweep_from(cell.profiles, cell.poses, config)
    parts = {**cell.reflector, 'ball': cell.reflector['ball'].mean(axis=0)}
    measured = jing2020.Tracker(**parts, h0=cell.h0, h1=cell.h1)

    def answers() -> Answers:
        swept = (sweep.points[sweep.part == part] for part in range(len(SWEPT)))
        yield 'Jing 2020', jing2020.solve(
            measured, jing2020.Sweep(*swept, sweep.q30)).T_flange_sensor
    field = grid((-0.02, 0.0, 0.02), (0.0,), (0.16, 0.175, 0.19))
    return Trial(cell.T_flange_sensor, field, answers())


CELLS: dict[str, Callable[[np.random.Generator], Trial]] = {
    'points in two frames, 0.03 mm': two_frames,
    **{f'poses, {name}': cell.trial for name, cell in {
        'camera 0.1 mm 1 mrad, robot 0.03 mm 0.1 mrad': Poses(),
        'camera 0.1 mm 1 mrad, robot exact': Poses(robot=(0, 0)),
        'camera exact, robot 0.1 mm 0.5 mrad': Poses((0, 0), (1e-4, 5e-4)),
        'camera 0.1 mm 0.2 mrad, robot 0.1 mm 1 mrad': Poses((1e-4, 2e-4), (1e-4, 1e-3)),
        'camera 0.1 mm 10 mrad, robot 0.03 mm 0.1 mrad': Poses((1e-4, 1e-2)),
        'camera 1 mm 0.3 mrad, robot 0.03 mm 0.1 mrad': Poses((1e-3, 3e-4)),
        'the fourth, camera on the base': Poses((1e-4, 2e-4), (1e-4, 1e-3), on_base=True),
        'the first, 4 views': Poses(count=4),
        'the first, 40 views': Poses(count=40),
        'the first, turns of 8, 8 and 15 degrees': Poses(tilts=(8, 8, 15)),
    }.items()},
    'laser tracker 0.02 mm, sensor 0.037 mm': by_tracker,
}


def answered(trial: Trial) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the name and the answer (4, 4) of each estimator, NaN where it has none."""
    for name, T in trial.answers:
        yield name, T if np.isfinite(T).all() else NO_ANSWER


def print_chain(found: dict[str, np.ndarray]) -> None:
    """Print e_v, e_theta and e_p of Jing 2020, and how many answers keep the limits."""
    print(f'{"":28} {"e_v":>8} {"e_theta":>8} {"95 %":>8} {"worst":>8} {"e_p":>8} {"95 %":>8} '
          f'{"worst":>8}  below {LIMITS[0]} degrees and {LIMITS[1]} mm')
    print(f'{"":28} {"":8} {"degrees":>8} {"":8} {"":8} {"mm":>8}')
    for name, values in found.items():
        e_v, e_theta, e_p = values.T
        e_theta, e_p = np.degrees(e_theta), 1e3 * e_p
        good = (e_theta < LIMITS[0]) & (e_p < LIMITS[1])
        print(f'{name:28} {np.median(e_v):8.5f} '
              + ' '.join(f'{np.median(e):8.4f} {np.quantile(e, 0.95):8.4f} {e.max():8.4f}'
                         for e in (e_theta, e_p)) + f'  {good.sum()} of {len(good)}')
    print(flush=True)


def run(make: Callable[[np.random.Generator], Trial], seeds: range
        ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the errors (n, 3) of each estimator in a cell, and e_v, e_theta, e_p (n, 3)."""
    found, chain = defaultdict(list), defaultdict(list)
    for seed in seeds:
        trial = make(np.random.default_rng(seed))
        for name, T in answered(trial):
            found[name].append(errors(T, trial.T_true, trial.points))
            chain[name].append(jing2020.errors(T, trial.T_true) if make is by_tracker else ())
    return ({name: np.array(values) for name, values in found.items()},
            {name: np.array(values) for name, values in chain.items()})


def main() -> None:
    """Print a table for each cell, or a line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--trials', type=int, default=50)
    parser.add_argument('--seed', type=int, default=1000)
    parser.add_argument('--only', default='', help='cells whose name holds this text')
    parser.add_argument('--brief', action='store_true', help='a line per cell')
    arguments = parser.parse_args()
    if arguments.brief:
        print(f'{arguments.trials} trials')
        print_header()
    for title, make in CELLS.items():
        if arguments.only not in title:
            continue
        found, chain = run(make, range(arguments.seed, arguments.seed + arguments.trials))
        if arguments.brief:
            print_nearest(title, found, OURS)
            continue
        print_table(f'{title}, {arguments.trials} trials', found)
        if make is by_tracker:
            print_chain(chain)


if __name__ == '__main__':
    main()
