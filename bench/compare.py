#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Our estimators beside the published ones, on the same simulated measurements.

usage: python bench/compare.py [--seeds N] [--first S] [--only TEXT] [--workers W]

For plate, sphere, line and plane: features with known noise (no profiles), which the settings
state, through what `handeye compare` runs; the line has one more row, what it makes of the face
lines in the same samples. Then what no profiler on a flange sees: points in two frames (Wu 2017),
A X = X B (CN105021139A, and OpenCV where it is installed; "noise known": ours, told the noise that
it else finds out from the residuals), the laser tracker (Jing 2020).
A row per estimator: medians of error (translation, rotation, points mapped from where the sensor
works; and its worst); then each median over ours, with its 95 % interval. Cells in which ours is
refused are told by their seeds, and take no part.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
import csv
from dataclasses import dataclass
from functools import partial
import math

from handeye_ros import se3
from handeye_ros.compare import compare
from handeye_ros.config import Config, with_values
from handeye_ros.errors import DataError
from handeye_ros.frames import mount_poses
from handeye_ros.published import park1994, wang2015, wu2017
from handeye_ros.simulate import SCENARIOS, settings, simulate_samples
from handeye_ros.simulate.tables import (
    CAMERA_STDS,
    laser_tracker,
    points_in_two_frames,
    poses_of_target,
    ROBOT_STDS,
)
from handeye_ros.tabulated.pairs import PointPairs, PosePairs
from handeye_ros.tabulated.tracker import PartPoints, sweep_from, TrackerProblem
import numpy as np
from scipy.spatial.transform import Rotation
import trials

try:
    import cv2
except ModuleNotFoundError:
    cv2 = None

OPENCV = ('TSAI', 'PARK', 'HORAUD', 'ANDREFF', 'DANIILIDIS')
NO_ANSWER = np.full(3, np.nan)


def of_target(target: str, seed: int) -> dict[str, np.ndarray]:
    """Return the errors (3,) of each estimator of a target in a simulated cell."""
    samples, truth = simulate_samples(SCENARIOS[target], np.random.default_rng(seed))
    # features are made without distortion
    config = with_values(Config(), settings(SCENARIOS[target]) | {'noise.distortion': 0.0}, target)
    rows = list(compare(samples, (), config, truth.T_flange_sensor, folds=0).rows)
    found = {row.name: row for row in rows}
    if target == 'line':
        config = with_values(config, {'target.use_face': True}, target)
        found['line, with its face'] = compare(
            samples, (), config, truth.T_flange_sensor, folds=0).rows[0]
    return {name: NO_ANSWER if row.failure else np.array([
        1e3 * row.figures['error_translation'], math.degrees(row.figures['error_rotation']),
        1e3 * row.figures['error_mapped_points']]) for name, row in found.items()}


def two_frames(seed: int) -> dict[str, np.ndarray]:
    """Return the errors of ten points, 0.03 mm per axis; they are mapped themselves."""
    rng = np.random.default_rng(1000 + seed)
    T = se3.transform(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-1, 1, 3))
    camera, base = points_in_two_frames(rng, T, middle=(0.0, 0.0, 0.0))
    found = {'points': PointPairs(Config(), camera, base).estimate().X,
             'Wu 2017, best of 210': wu2017.solve(camera, base)}
    exact = se3.apply(se3.inverse(T), base)
    return {name: trials.errors(X, T, exact) for name, X in found.items()}


@dataclass(frozen=True)
class Poses:
    """
    A cell of A X = X B: 1 sigma per axis (m, rad) of camera and robot, views, tilts (degrees).

    on_base: the camera stands beside the robot, which carries the target.
    """

    camera: tuple[float, float] = CAMERA_STDS
    robot: tuple[float, float] = ROBOT_STDS
    count: int = 12
    tilts: tuple[float, float, float] = (30, 30, 60)
    on_base: bool = False

    def errors(self, seed: int) -> dict[str, np.ndarray]:
        """Return the errors of each; mapped: x and y within +-50 mm, range 200-300 mm."""
        X, _, T, views = poses_of_target(np.random.default_rng(1000 + seed), self.robot,
                                         self.camera, self.on_base, self.count, self.tilts)
        side = (-0.05, 0.0, 0.05)
        field = np.stack(np.meshgrid(side, side, (0.2, 0.25, 0.3)), axis=-1).reshape(-1, 3)
        return {name: trials.errors(found, X, field) if np.isfinite(found).all() else NO_ANSWER
                for name, found in self.answers(T, views)}

    def answers(self, T: np.ndarray, views: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
        """Yield what each makes of the poses."""
        config = with_values(Config(), {
            'calibration_type': 'eye_on_base' if self.on_base else 'eye_in_hand'}, 'cell')
        T = mount_poses(T, config)
        poses = PosePairs(config, views, T)
        yield 'A X = X B', poses.estimate().X
        (camera, camera_turn), (robot, robot_turn) = np.square([self.camera, self.robot])
        known, _ = poses.fit_with_variances(poses.state_of(poses.closed_form()), np.array(
            [camera + robot, camera_turn, robot_turn]))
        yield 'A X = X B, noise known', known.state[0]
        yield 'CN105021139A', park1994.solve_motions(*wang2015.motions(T, views))
        for name in OPENCV if cv2 else ():
            try:
                R, t = cv2.calibrateHandEye(
                    T[:, :3, :3], T[:, :3, 3], views[:, :3, :3], views[:, :3, 3],
                    method=getattr(cv2, f'CALIB_HAND_EYE_{name}'))
            except cv2.error:
                R, t = np.full((3, 3), np.nan), np.full((3, 1), np.nan)
            yield f'OpenCV, {name.capitalize()}', se3.transform(R, t[:, 0])


def by_tracker(seed: int) -> dict[str, np.ndarray]:
    """Return the errors of arm, ball and block; tracker 0.02 mm, sensor 0.037 mm."""
    cell = laser_tracker(np.random.default_rng(1000 + seed))
    config = with_values(Config(), cell.settings, 'cell')
    swept, q30 = sweep_from(cell.profiles, cell.poses, config)
    measured: dict[str, list[PartPoints]] = {}
    for row, (kind, *point) in enumerate(csv.reader(cell.tables['tracker.csv'].splitlines()[1:])):
        measured.setdefault(kind, []).append(PartPoints(row, 1e-3 * np.array([point], float)))
    session = TrackerProblem(config, {**measured, **swept}, q30)
    found = session.result.T_flange_sensor
    x, z = np.meshgrid((-0.02, 0.0, 0.02), (0.16, 0.175, 0.19))
    field = np.column_stack([x.ravel(), np.zeros(x.size), z.ravel()])
    return {'Jing 2020': trials.errors(found, cell.T_flange_sensor, field)}


CELLS: dict[str, Callable[[int], dict[str, np.ndarray]]] = {
    **{target: partial(of_target, target) for target in ('plate', 'sphere', 'line', 'plane')},
    'points in two frames, 0.03 mm': two_frames,
    'poses, camera 0.1 mm 1 mrad, robot 0.03 mm 0.1 mrad': Poses().errors,
    'poses, camera 0.1 mm 0.2 mrad, robot 0.1 mm 1 mrad': Poses((1e-4, 2e-4), (1e-4, 1e-3)).errors,
    'poses, the same, camera on the base': Poses((1e-4, 2e-4), (1e-4, 1e-3), on_base=True).errors,
    'poses, the first, 4 views': Poses(count=4).errors,
    'poses, the first, turns of 8, 8 and 15 degrees': Poses(tilts=(8, 8, 15)).errors,
    'laser tracker 0.02 mm, sensor 0.037 mm': by_tracker,
}


def trial(job: tuple[str, int]) -> dict[str, np.ndarray] | None:
    """Return the errors (3,) of each estimator in a cell, by its name, with a seed."""
    try:
        return CELLS[job[0]](job[1])
    except DataError:
        return None


def main() -> None:
    """Print a table for each cell."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    trials.add_options(parser, 50)
    arguments = parser.parse_args()
    titles, seeds = [t for t in CELLS if arguments.only in t], trials.seeds_of(arguments)
    jobs = [(title, seed) for title in titles for seed in seeds]
    found = trials.results(trial, jobs, arguments.workers)
    for title in titles:
        cells = {seed: next(found) for seed in seeds}
        rows = [row for row in cells.values() if row]
        if rows:
            trials.print_table(f'{title}, {len(rows)} trials', {
                name: np.array([row[name] for row in rows]) for name in rows[0]})
        if refused := [seed for seed, row in cells.items() if not row]:
            print('refused, seeds:', *refused)


if __name__ == '__main__':
    main()
