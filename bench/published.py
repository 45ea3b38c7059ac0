#!/usr/bin/env python3
"""
Our estimators beside the published ones where no profile of a flange is involved.

usage: python bench/published.py [--trials N]

Points in two frames (Wu 2017), A X = X B (CN105021139A, and OpenCV where it is installed), the
laser tracker (Jing 2020). Both get the same simulated measurements. Medians over the trials of
the errors of translation and rotation; for the points, of the transform at their middle. For
the targets that a profiler on the flange sees: bench/compare.py.
"""
from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Callable, Iterator

from handeye_ros import se3
from handeye_ros.config import Config, with_values
from handeye_ros.methods import hand_eye, points, tracker
from handeye_ros.published import cn105021139a, jing2020, wu2017
from handeye_ros.simulate.tracker import RADIUS, SENSOR, simulate_tracker
from handeye_ros.sweeps import sweep_from
import numpy as np
from scipy.spatial.transform import Rotation

try:
    import cv2
except ModuleNotFoundError:
    cv2 = None

Answers = Iterator[tuple[str, np.ndarray, np.ndarray]]

OPENCV = ('TSAI', 'PARK', 'HORAUD', 'ANDREFF', 'DANIILIDIS')


def two_frames(rng: np.random.Generator) -> Answers:
    """Yield answers for ten points, 0.03 mm per axis."""
    T = se3.transform(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-1, 1, 3))
    base = rng.uniform(-0.15, 0.15, (10, 3))
    camera = se3.apply(se3.inverse(T), base) + 3e-5 * rng.normal(size=(10, 3))
    yield 'points', points.solve(camera, base).T_base_camera, T
    yield 'Wu 2017, best of 210', wu2017.solve(camera, base).T_base_camera, T


def poses(rng: np.random.Generator) -> Answers:
    """Yield answers for 12 views, 0.1 mm and 1 mrad; the robot 0.03 mm and 0.1 mrad."""
    X = se3.transform(Rotation.random(random_state=rng).as_matrix(), 0.1 * rng.normal(size=3))
    Z = se3.transform(Rotation.random(random_state=rng).as_matrix(), np.array([0.7, 0.1, 0.2]))
    turns = rng.uniform([-30, -30, -60], [30, 30, 60], (12, 3))
    R = Rotation.from_euler('xyz', turns, degrees=True).as_matrix() @ np.diag([1.0, -1, -1])
    views = se3.transform(R, rng.uniform([-0.05, -0.05, 0.2], [0.05, 0.05, 0.3], (12, 3)))
    T = off_by(Z @ se3.inverse(views) @ se3.inverse(X), 3e-5, 1e-4, rng)
    views = off_by(views, 1e-4, 1e-3, rng)
    yield 'A X = X B', hand_eye.solve(T, views).T_flange_camera, X
    motions = cn105021139a.motions(T, views)
    yield 'CN105021139A', cn105021139a.solve_motions(*motions), X
    for name in OPENCV if cv2 else ():
        R, t = cv2.calibrateHandEye(T[:, :3, :3], T[:, :3, 3], views[:, :3, :3], views[:, :3, 3],
                                    method=getattr(cv2, f'CALIB_HAND_EYE_{name}'))
        yield f'OpenCV, {name.capitalize()}', se3.transform(R, t[:, 0]), X


def off_by(T: np.ndarray, shift: float, turn: float, rng: np.random.Generator) -> np.ndarray:
    """Return poses (n, 4, 4) with noise per axis (m, rad)."""
    e = rng.normal(size=(len(T), 6)) * np.repeat([shift, turn], 3)
    return se3.transform(se3.exp_rotation(e[:, 3:]) @ T[:, :3, :3], T[:, :3, 3] + e[:, :3])


def by_tracker(rng: np.random.Generator) -> Answers:
    """Yield answers for an arm, ball and block; tracker 0.02 mm, sensor 0.037 mm."""
    cell = simulate_tracker(rng)
    config = with_values(Config(), {'noise.sensor': SENSOR.noise, 'target.radius': RADIUS}, 'cell')
    sweep = sweep_from(cell.profiles, cell.poses, config, cell.q3_first, cell.q30)
    parts = {**cell.reflector, 'ball': cell.reflector['ball'].mean(axis=0)}
    measured = jing2020.Tracker(**parts, h0=cell.h0, h1=cell.h1)
    yield 'laser tracker', tracker.solve(measured, sweep).T_flange_sensor, cell.T_flange_sensor
    chain = jing2020.solve(measured, sweep.published)
    yield 'Jing 2020', chain.T_flange_sensor, cell.T_flange_sensor


CELLS: dict[str, Callable[[np.random.Generator], Answers]] = {
    'points in two frames': two_frames, 'poses of a camera': poses, 'laser tracker': by_tracker}


def main() -> None:
    """Print a table for each cell."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--trials', type=int, default=50)
    trials = parser.parse_args().trials
    for title, answers in CELLS.items():
        errors = defaultdict(list)
        for seed in range(trials):
            for name, T, T_true in answers(np.random.default_rng(seed)):
                delta = se3.difference(T, T_true)
                errors[name].append((1e3 * np.linalg.norm(delta[:3]),
                                     np.degrees(np.linalg.norm(delta[3:]))))
        print(f'{title}, {trials} trials: median, worst')
        print(f'{"":24} {"transl., mm":>16} {"rotation, degrees":>18}')
        for name, values in errors.items():
            (t, r), (t_worst, r_worst) = np.median(values, axis=0), np.max(values, axis=0)
            print(f'{name:24} {t:8.4f} {t_worst:7.4f} {r:10.4f} {r_worst:7.4f}', flush=True)
        print()


if __name__ == '__main__':
    main()
