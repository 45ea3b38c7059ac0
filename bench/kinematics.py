# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Robots with errors of their own: how well their joints are found, and what is left of the error.

usage: .venv/bin/python bench/kinematics.py [--seeds N] [--stops N] [CASE...]

Each seed draws a robot whose flange is off by the stated RMS over its workspace, a sensor on it,
and configurations that see one ball (noise 0.03 mm each axis); 22 more are held out. "before" and
"after": RMS error of where held-out balls are predicted, without their noise (mm), with the URDF
as it is and with the answer; "bound": what the best estimator with the true sizes of all errors
would reach, of what the model holds. "NEES": squared error of the hand-eye transform over its
stated covariance, over 6: 1 is honest. "95 %": how often it lies in its stated region. "joints":
how often a parameter lies within 2 sigma.
"""
from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
import time

from handeye_ros import se3
from handeye_ros.arm import Arm, arm_of, KIND_OF_ERROR, KINDS
from handeye_ros.config import Config, with_values
from handeye_ros.data import Array, Sample
from handeye_ros.estimation.problem import Problem
from handeye_ros.frames import mount_poses
from handeye_ros.robot.fit import ArmFit, ArmPoints, with_estimated_weights
from handeye_ros.robot.from_recordings import ArmSamples, fit_of_samples
from handeye_ros.robot.from_table import select_from_points
from handeye_ros.robot.selection import ArmSelection, select_model
from handeye_ros.sampling.session import Session
from handeye_ros.simulate import recording as cells
from handeye_ros.simulate import robot, SCENARIOS, settings
from handeye_ros.simulate.scenes import SCENES
from handeye_ros.targets import target_for
import numpy as np
from scipy.stats import chi2
import trials

NOISE, HELD_OUT, LIMIT = 3e-5, 22, 1e-3
# xyz of each joint's origin in the joint before, its axis, and its limits (rad)
SIX = (((0, 0, 0.495), (0, 0, 1), 3.1), ((0.175, 0, 0), (0, 1, 0), 1.6),
       ((0, 0, 0.9), (0, 1, 0), 2.5), ((0, 0, 0.175), (1, 0, 0), 6.0),
       ((0.96, 0, 0), (0, 1, 0), 2.1), ((0.135, 0, 0), (1, 0, 0), 6.0))
SEVEN = (((0, 0, 0.34), (0, 0, 1), 2.9), ((0, 0, 0), (0, 1, 0), 2.1),
         ((0, 0, 0.4), (0, 0, 1), 2.9), ((0, 0, 0), (0, -1, 0), 2.1),
         ((0, 0, 0.4), (0, 0, 1), 2.9), ((0, 0, 0), (0, 1, 0), 2.1),
         ((0, 0, 0.126), (0, 0, 1), 3.0))
STARTS = {6: (0.0, 0.1, 0.3, 0.0, 1.0, 0.0), 7: (0.0, 0.6, 0.0, -1.2, 0.0, 1.2, 0.0)}
SPREADS = {6: (0.5, 0.3, 0.4, 2.0, 0.8, 2.0), 7: (0.5, 0.4, 0.8, 0.5, 1.0, 0.6, 2.0)}
BALLS = {6: (1.5, 0.1, 0.5), 7: (0.65, 0.05, 0.15)}


@dataclass(frozen=True)
class Case:
    """A kind of robots: its joints, and RMS of its error (m)."""

    joints: tuple = SIX
    error: float = 5e-4
    on_flange: bool = True


PROFILES = {'plate': (20, 20), 'sphere': (40, 0), 'line': (40, 0), 'plane': (40, 0),
            'wedge': (40, 0)}  # scenes, and how many stops
LINKS = 4e-4  # 1 sigma of errors of joints and links of the arm that sees these (m, rad of 1 m)
CASES = {
    'six': Case(), 'seven': Case(SEVEN), 'small': Case(error=1e-4), 'large': Case(error=1e-3),
    'none': Case(error=0.0), 'beside': Case(on_flange=False),
}


def urdf(joints: tuple) -> str:
    """Return the URDF of joints in a row, with a last fixed frame."""
    links = ''.join(f'<link name="link_{k}"/>' for k in range(len(joints) + 1))
    moving = ''.join(
        f'<joint name="joint_{k}" type="revolute"><origin xyz="{x} {y} {z}"/>'
        f'<parent link="link_{k - 1}"/><child link="link_{k}"/>'
        f'<axis xyz="{" ".join(map(str, axis))}"/>'
        f'<limit lower="{-limit}" upper="{limit}" effort="0" velocity="0"/></joint>'
        for k, ((x, y, z), axis, limit) in enumerate(joints, 1))
    return (f'<?xml version="1.0"?><robot name="arm">{links}<link name="tool0"/>{moving}'
            f'<joint name="end" type="fixed"><origin xyz="0 0 0.05" rpy="0 1.5708 0"/>'
            f'<parent link="link_{len(joints)}"/><child link="tool0"/></joint></robot>')


@dataclass(frozen=True, eq=False)
class Cell:
    """What is true: the arm, the sensor, the ball; the points seen, with and without noise."""

    arm: Arm
    X: Array
    ball: Array
    data: ArmPoints
    exact: ArmPoints


def draw(case: Case, stops: int, seed: int) -> Cell:
    """Return a robot with its errors, and configurations that see the ball."""
    rng, n = np.random.default_rng(seed), len(case.joints)
    stated = arm_of(urdf(case.joints))
    errors = stated.prior_stds * np.hstack([
        rng.normal(size=(n, (KIND_OF_ERROR == kind).sum())) for kind in KINDS])
    arm = replace(stated, estimated_kinds=KINDS, error_values=errors.ravel())
    near = rng.uniform(-1, 1, (200, n)) * SPREADS[n] + STARTS[n]
    off = arm.forward(near)[:, :3, 3] - stated.forward(near)[:, :3, 3]
    rms = np.sqrt(((off - off.mean(axis=0)) ** 2).sum(axis=1).mean())
    arm = replace(arm, error_values=arm.error_values * case.error / rms)
    X = se3.perturb(np.eye(4), rng.uniform([-.1, -.1, .1, -.4, -.4, -3], [.1, .1, .2, .4, .4, 3]))
    ball = np.array(BALLS[n])
    if not case.on_flange:
        X, ball = se3.transform(X[:3, :3], ball + X[:3, 3] - [0, 0, 0.2]), X[:3, 3]
    q, points = [], []
    while len(q) < stops:
        found = _seen(arm, X, ball, case, rng)
        if found is not None:
            q.append(found[0])
            points.append(found[1])
    exact = ArmPoints(np.array(q), np.array(points), case.on_flange)
    noise = rng.normal(size=(stops, 3)) * NOISE
    return Cell(arm, X, ball, replace(exact, points=exact.points + noise), exact)


def _seen(arm: Arm, X: Array, ball: Array, case: Case, rng: np.random.Generator
          ) -> tuple[Array, Array] | None:
    """Return joint values that bring the ball near a point of the field of view, and where."""
    n = len(case.joints)
    q = STARTS[n] + rng.uniform(-1, 1, n) * SPREADS[n]
    wanted = rng.uniform([-0.03, -0.02, 0.15], [0.03, 0.02, 0.25])
    for _ in range(12):
        T = arm.forward(q[None])[0]
        off, J = _off(arm, q, X, ball, wanted, case.on_flange)
        if np.linalg.norm(off) < 1e-3:
            break
        q = q - np.clip(J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(3), off), -0.3, 0.3)
    T = arm.forward(q[None])[0]
    point = (se3.inverse(T @ X) @ np.append(ball, 1) if case.on_flange else
             se3.inverse(X) @ T @ np.append(ball, 1))[:3]
    limits = np.array([limit for _, _, limit in case.joints])
    inside = (np.abs(q) < limits).all() and np.abs(point - wanted).max() < 0.01
    return (q, point) if inside else None


def _off(arm: Arm, q: Array, X: Array, ball: Array, wanted: Array, on_flange: bool
         ) -> tuple[Array, Array]:
    stated = arm.with_errors_of(())
    T, twists = stated.forward(q[None]), stated.error_jacobian(q[None])[..., 0]
    carried, fixed = (X @ np.append(wanted, 1), np.append(ball, 1)) if on_flange else (
        np.append(ball, 1), X @ np.append(wanted, 1))
    there = (T[0] @ carried)[:3]
    J = twists[0, :3] + np.cross(twists[0, 3:], (there - T[0, :3, 3])[:, None], axis=0)
    return there - fixed[:3], J


def selected(data: ArmPoints, keep: Array) -> ArmPoints:
    """Return some points, by a mask."""
    return replace(data, q=data.q[keep], points=data.points[keep])


def predicted(fit: ArmFit, data: ArmPoints) -> Array:
    """Return where the points (n, 3) are in the sensor, by an estimate."""
    ball, = fit.targets
    return se3.apply(se3.inverse(data.mount_poses(fit.arm) @ fit.X), ball[None])[:, 0]


def rms(off: Array) -> float:
    """Return the RMS length (mm)."""
    return float(np.sqrt((off ** 2).sum(axis=1).mean())) * 1e3


def bound(cell: Cell, rows: ArmPoints, held: ArmPoints) -> float:
    """Return the RMS error (mm) of the best prediction that knows the sizes of all errors."""
    scale = max(float(np.sqrt(((cell.arm.errors / cell.arm.prior_stds) ** 2).mean())), 1e-6)
    seen, others = (replace(ArmFit.of_arm(
        cell.arm, [each], cell.X, [cell.ball], np.full(3, NOISE)),
        tau_squares=np.full(3, scale ** 2)) for each in (rows, held))
    best = seen.solved()
    J = replace(others, X=best.X, arm=best.arm, targets=best.targets).whitened_rows[1]
    variances = np.einsum('mi,ij,mj->m', J, best.covariance, J).reshape(-1, 3)
    return float(np.sqrt(variances.sum(axis=1).mean())) * 1e3 * NOISE


def judged(cell: Cell, case: Case, selection: ArmSelection, held: ArmPoints) -> tuple[float, ...]:
    """Return before and after (mm), NEES over 6, and the share of parameters within 2 sigma."""
    before, after = (rms(predicted(m.fit, held) - held.points)
                     for m in (selection.models[0], selection.chosen))
    nees = trials.nees(selection.chosen.fit.X, selection.covariance, cell.X) / 6
    arm = selection.arm
    off = np.abs(arm.errors - cell.arm.errors)[arm.is_estimated]
    inside = off < 2 * np.maximum(np.sqrt(np.diag(arm.covariance)), 1e-12)
    return before, after, nees, float(inside.mean()) if len(off) else 1.0


def shown(name: str, rng: np.random.Generator, share: int, other: cells.Cell | None
          ) -> tuple[cells.Cell, ArmSamples]:
    """
    Return a cell, and what stops at its target show, by the poses of the arm as stated.

    share: of how many targets this is one; other: a cell of which sensor and arm are taken.
    """
    scenario = SCENARIOS[name]
    scenario = replace(scenario, robot=replace(scenario.robot, geometry=LINKS), tilt=0.6,
                       stops=tuple(n * 4 // 3 // share for n in PROFILES[name]))
    scene = SCENES[scenario.scene]
    stops = scene.placements(scenario, rng)
    stops = stops.ordered(rng.permutation(len(stops.labels)))
    cell = cells.cell_of(scenario, stops, rng)
    if other:
        X = other.T_mount_sensor
        T = cell.T_base_flange @ cell.T_mount_sensor @ se3.inverse(X)
        cell = replace(cell, arm_errors=other.arm_errors, T_mount_sensor=X, T_base_flange=T)
    T = cell.T_base_flange
    T = se3.perturb(T, robot.pose_error(scenario.robot, T, rng))
    T = se3.perturb(T, robot.arm_pose_error(T, cell.arm_errors))
    features = scene.features(scenario, stops, rng)
    config = with_values(Config(), settings(scenario), 'the scenario')
    samples = [Sample(k, pose, found, 30)
               for k, (pose, found) in enumerate(zip(T, features, strict=True))]
    method, q = target_for(config), robot.inverse(T)
    poses = mount_poses(arm_of(robot.URDF).forward(q), config)
    problem = Problem(method, poses, method.observe(samples), config)
    return cell, ArmSamples(Session(config), samples, problem, q)


def seen_by_profiles(name: str, seed: int) -> tuple[float, ...]:
    """
    Return before and after (mm), NEES over 6, of stops at a target; of 3 in 4 stops.

    name: of several with + between; before, after: RMS of the residuals of the other stops.
    """
    rng, names, cell, sources = np.random.default_rng(seed), name.split('+'), None, []
    for each in names:
        cell, source = shown(each, rng, len(names), cell)
        sources.append(source)
    start = fit_of_samples(sources, arm_of(robot.URDF))
    used = np.concatenate([np.arange(len(one.q)) < 0.75 * len(one.q) for one in start.measured])
    fit = with_estimated_weights(replace(start, used=used))
    selection = select_model(fit, used.sum(), LIMIT)
    before, after = (float(np.sqrt((m.fit.distances[~used] ** 2).mean())) * 1e3
                     for m in (selection.models[0], selection.chosen))
    return before, after, trials.nees(selection.chosen.fit.X, selection.covariance,
                                      cell.arm_errors.flange @ cell.T_mount_sensor) / 6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--seeds', type=int, default=10)
    parser.add_argument('--stops', type=int, default=40)
    parser.add_argument('cases', nargs='*', default=[*CASES, *PROFILES, 'plate+sphere'])
    given = parser.parse_args()
    print(f'{"case":14} {"before":>7} {"after":>7} {"bound":>7} {"ratio":>6} {"NEES":>6} '
          f'{"95 %":>5} {"joints":>6} {"time":>6}')
    for name in given.cases:
        if name not in CASES:
            rows = np.array([seen_by_profiles(name, seed) for seed in range(given.seeds)])
            before, after, nees = rows.T
            print(f'{name:14} {np.median(before):7.3f} {np.median(after):7.3f} {"":7} {"":6} '
                  f'{nees.mean():6.2f} {(6 * nees < chi2.ppf(0.95, 6)).mean():5.2f}', flush=True)
            continue
        case, rows, times = CASES[name], [], []
        for seed in range(given.seeds):
            cell = draw(case, given.stops + HELD_OUT, seed)
            first = np.arange(len(cell.data.q)) < given.stops
            began = time.perf_counter()
            seen, held = selected(cell.data, first), selected(cell.exact, ~first)
            selection = select_from_points([seen], cell.arm.with_errors_of(()), LIMIT)
            times.append(time.perf_counter() - began)
            rows.append((*judged(cell, case, selection, held),
                         bound(cell, seen, held)))
        before, after, nees, joints, best = np.array(rows).T
        print(f'{name:14} {np.median(before):7.3f} {np.median(after):7.3f} '
              f'{np.median(best):7.3f} {np.median(after / best):6.2f} {nees.mean():6.2f} '
              f'{(6 * nees < chi2.ppf(0.95, 6)).mean():5.2f} {joints.mean():6.2f} '
              f'{np.median(times):5.1f}s', flush=True)


if __name__ == '__main__':
    main()
