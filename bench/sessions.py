#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What is said of bad sessions, of wrong settings, and of a sensor or target that moved.

usage: python bench/sessions.py [bad|moves|settings] [--seeds N] [--first S] [--only TEXT]
                                [--workers W]

bad (default): bad sessions must not be answered, good ones must not be refused. Of each kind N
sessions (features with known noise, no profiles); a row per kind: how many were answered, how many
of the answers were wrong (mapped points off by more than 5 sigma and 0.3 mm), and the reasons of
the refusals.

moves: a sensor or target that moves a little half-way must be told; a poor robot must not be
called so. How many of the recordings of a row were refused or answered with a warning of a move,
how many of these name the moment within one stop, and of those not told how many answers were
wrong (NEES > 12.6, the 95 % limit of six numbers). The rows without a move are false alarms.

settings: a recording of each target is read with each wrong setting. A cell is good where the
first sentence names a setting that is wrong with its right value, or where the answer is right all
the same (a plate has planes and straight edges); it is mended where the advice, obeyed up to three
times, leads to a right answer. Prints the cells that are not, a row per recording, and the sums.
"""
from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
import math
from pathlib import Path
import re
import tempfile

from handeye_ros import pipeline, read_bag, se3
from handeye_ros.bags import writer
from handeye_ros.config import Config, with_assignments, with_values
from handeye_ros.data import Array, Calibration, Sample
from handeye_ros.errors import DataError, HandeyeError
from handeye_ros.simulate import FAULTS, Scenario, SCENARIOS, settings, simulate, simulate_samples
from handeye_ros.simulate.robot import WRONG_CONVENTIONS
import numpy as np
from scipy.stats import chi2
import trials

# -- bad sessions


Damage = Callable[[list[Sample], np.random.Generator], list[Sample]]


@dataclass(frozen=True)
class Kind:
    """A kind of session: its cell, and what is done to its samples."""

    good: bool
    scenario: Scenario
    damage: Damage = lambda samples, rng: samples


def with_poses(samples: list[Sample], poses: Array) -> list[Sample]:
    """Return samples with other poses (n, 4, 4)."""
    return [replace(s, T_base_flange=T) for s, T in zip(samples, poses, strict=True)]


def poses_of(samples: list[Sample]) -> Array:
    """Return the poses (n, 4, 4) of samples."""
    return np.array([s.T_base_flange for s in samples])


def wrong_convention(name: str) -> Damage:
    """Return the damage that a wrong convention of the simulator does to all poses."""
    def apply(samples: list[Sample], rng: np.random.Generator) -> list[Sample]:
        T = poses_of(samples)
        translation, quaternion = WRONG_CONVENTIONS[name](T[:, :3, 3], se3.quaternion(T))
        return with_poses(samples, se3.from_quaternion(translation, quaternion))
    return apply


def mispaired(samples: list[Sample], rng: np.random.Generator) -> list[Sample]:
    """Give every sample the pose of the stop before."""
    return with_poses(samples, np.roll(poses_of(samples), 1, axis=0))


def shuffled(samples: list[Sample], rng: np.random.Generator) -> list[Sample]:
    """Give every sample the pose of any stop."""
    T = poses_of(samples)
    return with_poses(samples, T[rng.permutation(len(T))])


def displaced(share: float, distance: float, together: bool) -> Damage:
    """Return the damage of poses moved by a distance, all alike or each its own way."""
    def apply(samples: list[Sample], rng: np.random.Generator) -> list[Sample]:
        T = poses_of(samples)
        wrong = rng.permutation(len(T))[:round(share * len(T))]
        ways = rng.normal(size=(1 if together else len(wrong), 3))
        T[wrong, :3, 3] += distance * ways / np.linalg.norm(ways, axis=1)[:, None]
        return with_poses(samples, T)
    return apply


PLATE, SPHERE = SCENARIOS['plate'], SCENARIOS['sphere']
SYSTEMATIC = SCENARIOS['plate_real_robot'].robot
KINDS = {
    'plate': Kind(True, PLATE), 'sphere': Kind(True, SPHERE),
    'plate 5 + 5': Kind(True, SCENARIOS['plate_5_5']),
    'eye on base': Kind(True, SCENARIOS['eye_on_base']),
    'systematic robot': Kind(True, replace(PLATE, robot=SYSTEMATIC)),
    'systematic robot, sphere': Kind(True, replace(SPHERE, robot=SYSTEMATIC)),
    '2 stops at other edges': Kind(True, SCENARIOS['wrong_edges']),
    '20 % moved 5 mm': Kind(True, PLATE, displaced(0.2, 5e-3, False)),
    '28 % moved 5 mm together': Kind(True, PLATE, displaced(0.28, 5e-3, True)),
    'one orientation': Kind(False, SCENARIOS['one_orientation']),
    'one orientation per edge': Kind(False, SCENARIOS['one_orientation_per_edge']),
    'tilt only': Kind(False, SCENARIOS['tilt_only']),
    'yaw only': Kind(False, SCENARIOS['yaw_only']),
    'tilts of 0.3 degrees': Kind(False, replace(PLATE, tilt=math.radians(0.3))),
    'mispaired': Kind(False, PLATE, mispaired),
    'shuffled poses': Kind(False, PLATE, shuffled),
    'shuffled poses, sphere': Kind(False, SPHERE, shuffled),
    '60 % moved 5 mm': Kind(False, PLATE, displaced(0.6, 5e-3, False)),
    **{f'convention {name}': Kind(False, PLATE, wrong_convention(name))
       for name in WRONG_CONVENTIONS},
    **{f'convention {name}, sphere': Kind(False, SPHERE, wrong_convention(name))
       for name in WRONG_CONVENTIONS},
}


def session(job: tuple[str, int]) -> tuple[str, bool]:
    """Return why a session of a kind was refused, '' for an answer, and if that is wrong."""
    kind, rng = KINDS[job[0]], np.random.default_rng(job[1])
    samples, truth = simulate_samples(kind.scenario, rng)
    config = with_values(Config(), settings(kind.scenario) | {'noise.distortion': 0.0}, job[0])
    try:
        found = pipeline.solve(kind.damage(list(samples), rng), (), config, 'laser')
    except DataError as error:
        return error.code or type(error).__name__, False
    X, X_true = found.T_flange_sensor, truth.T_flange_sensor
    delta = se3.difference(X, X_true)
    sigmas = math.sqrt(trials.nees(X, found.covariance, X_true) / 6)
    lever = np.linalg.norm(delta[:3]) + 0.175 * np.linalg.norm(delta[3:])
    return '', bool(sigmas > 5 and lever > 3e-4)


def bad(arguments: argparse.Namespace) -> None:
    """Print what becomes of good and bad sessions."""
    names, seeds = [n for n in KINDS if arguments.only in n], trials.seeds_of(arguments)
    outcomes = trials.results(session, [(name, seed) for name in names for seed in seeds],
                              arguments.workers)
    answered = Counter[bool]()
    print(f'{"session":28} {"answered":>9} {"wrong":>6}  refusals')
    for name in names:
        found = [next(outcomes) for _ in seeds]
        reasons = Counter(reason for reason, _ in found if reason)
        answers = len(found) - reasons.total()
        answered[KINDS[name].good] += answers
        print(f'{name:28} {answers:4}/{len(found):<4} {sum(wrong for _, wrong in found):6}  '
              + ', '.join(f'{r} {n}' for r, n in reasons.items()), flush=True)
    print(f'bad sessions answered: {answered[False]}; good sessions answered: {answered[True]}')


# -- moves


LIMIT = chi2.ppf(0.95, 6)
MOVES = {'sensor 3 mrad': (0.0, 3e-3), 'sensor 0.5 mm': (5e-4, 0.0), 'target 0.5 mm': (5e-4, 0.0)}
MOVED = tuple(f'{target}, baseline' for target in ('plate', 'sphere', 'plane', 'wedge'))
UNMOVED = (*MOVED, 'line, baseline', 'distorted 0.02 mm', 'joints and links 0.1 mm',
           'joints and links 0.3 mm', 'smooth 0.2 mm', 'sphere, smooth 0.2 mm',
           'plane, smooth 0.2 mm', 'wedge, smooth 0.2 mm', 'repeatability 1.3 times stated')


def moved(samples: list[Sample], X: Array, what: str, rng: np.random.Generator) -> list[Sample]:
    """Return samples in order of time, the later half as if sensor or target had moved."""
    step = np.concatenate([length * v / np.linalg.norm(v) for length, v in zip(
        MOVES[what], rng.normal(size=(2, 3)), strict=True)])
    E = se3.perturb(np.eye(4), step)
    half = len(samples) // 2
    # the flange reported is that from which an unmoved sensor would have seen the same
    before = se3.inverse(X @ E @ se3.inverse(X))
    of_sensor = what.startswith('sensor')
    return samples[:half] + [
        replace(s, T_base_flange=s.T_base_flange @ before if of_sensor else E @ s.T_base_flange)
        for s in samples[half:]]


def told(job: tuple[str, str, int]) -> str:
    """Return what is said of a recording of a cell with a move ('' for none) and a seed."""
    scenario, what, rng = FAULTS[job[0]], job[1], np.random.default_rng(job[2])
    config, made = with_values(Config(), settings(scenario), 'bench'), simulate(scenario, rng)
    found, X = pipeline.gather(made.profiles, made.poses, config), made.truth.T_flange_sensor
    samples = sorted(found.samples, key=lambda sample: sample.stamp)
    half = len(samples) // 2
    try:
        answer = pipeline.solve(moved(samples, X, what, rng) if what else samples, (), config,
                                'laser')
    except DataError as error:
        return _when(str(error), half) or f'refused otherwise ({error.code})'
    for warning in answer.provenance.get('warnings', ()):
        if result := _when(warning, half):
            return result.replace('refused', 'warned')
    wrong = trials.nees(answer.T_flange_sensor, answer.covariance, X) > LIMIT
    return 'not told, wrong' if wrong else 'not told'


def _when(text: str, half: int) -> str:
    found = re.search(r'the first (\d+) (?:of \d+ )?samples', text)
    if not found:
        return ''
    return 'refused' if abs(int(found[1]) - half) < 2 else 'refused, other moment'


def moves(arguments: argparse.Namespace) -> None:
    """Print what is said of moves, and of poor robots."""
    rows = [(cell, what) for cell in MOVED for what in MOVES] + [(cell, '') for cell in UNMOVED]
    titles = {f'{cell}, {what or "nothing moved"}': (cell, what) for cell, what in rows}
    titles = {title: row for title, row in titles.items() if arguments.only in title}
    seeds = trials.seeds_of(arguments)
    outcomes = trials.results(told, [(*row, seed) for row in titles.values() for seed in seeds],
                              arguments.workers)
    for title in titles:
        found = Counter(next(outcomes) for _ in seeds)
        print(f'{title:40} ' + ', '.join(f'{n} {text}' for text, n in found.most_common()),
              flush=True)


# -- wrong settings


TARGETS = ('plate', 'sphere', 'line', 'plane', 'wedge')
CELLS = (*(f'{target}, {cell}' for cell in ('baseline', 'wide off-centre') for target in TARGETS),
         'eye_on_base')
LIKELY = 22.5  # NEES of six numbers, that right ones exceed in one of 1000
AXES = ('[x, z]', '[z, x]', '[y, z]', '[x, y]', '[z, y]', '[y, x]')
RIGHT = 2e-3  # m or 10 times as many rad: nearer than this no setting is wrong


def wrong(right: dict[str, str]) -> Iterator[dict[str, str]]:
    """Yield settings that are wrong."""
    yield from ({'target.type': name} for name in TARGETS if name != right['target.type'])
    yield from ({'profile.axes': axes} for axes in AXES if axes != right['profile.axes'])
    yield {'profile.unit': 'mm'}
    yield {'time_offset': '1.0'}
    sign = {'profile.range_sign': str(-int(right['profile.range_sign']))}
    yield sign
    on_base = right['calibration_type'] == 'eye_on_base'
    yield {'calibration_type': 'eye_in_hand' if on_base else 'eye_on_base'}
    yield {'profile.axes': AXES[1]} | sign
    yield from ({'target.type': name} | sign for name in TARGETS if name != right['target.type'])


def of_settings(job: tuple[str, int]) -> list[tuple[str, str, bool, bool]]:
    """Return each wrong setting of a recording, what is said, if it is good, and if it mends."""
    name, seed = job
    scenario = FAULTS.get(name) or SCENARIOS[name]
    right = {'profile.axes': '[x, z]', 'profile.range_sign': '1', 'profile.unit': 'm',
             'time_offset': '0.0'} | {
        key: f'[{", ".join(value)}]' if isinstance(value, list) else str(value)
        for key, value in settings(scenario).items()}
    with tempfile.TemporaryDirectory() as folder:
        path, made = Path(folder) / 'bag', simulate(scenario, np.random.default_rng(seed))
        writer.write(path, made.profiles, made.poses)
        config = with_values(Config(), settings(scenario), 'bench')
        return [(', '.join(f'{key}={value}' for key, value in changes.items()),
                 *read_with(path, config, changes, right, made.truth.T_flange_sensor))
                for changes in wrong(right)]


def read_with(path: Path, config: Config, changes: dict[str, str], right: dict[str, str], T: Array
              ) -> tuple[str, bool, bool]:
    """Return what is said with wrong settings, whether it is good, and whether to obey helps."""
    config = _with(config, changes)
    answer = _solved(path, config)
    if isinstance(answer, Calibration):
        good = _near(answer, T)
        return 'answered' + ('' if good else ', wrong'), good, good
    sentence = answer.split(': check')[0]
    first = _advice(sentence)
    for _ in range(3):  # one advice after the other
        if isinstance(answer, Calibration) or not (advice := _advice(answer)):
            break
        config = _with(config, advice)
        answer = _solved(path, config)
    mended = isinstance(answer, Calibration) and _near(answer, T)
    # a plane may be meant where a line was recorded: the setting is named, and both are right
    good = any(first.get(key) == right[key] or (key in first and mended) for key in changes)
    return sentence, good, mended


def _with(config: Config, values: dict[str, str]) -> Config:
    return with_assignments(config, [f'{key}={value}' for key, value in values.items()])


def _advice(sentence: str) -> dict[str, str]:
    """Return the values that a refusal says are to be set."""
    value = r'(?: to)? (\[[^]]*\]|-?\d+(?:\.\d+)?|eye_\w+|m+\b|' + '|'.join(TARGETS) + ')'
    return dict(re.findall(r'(target\.type|profile\.\w+|calibration_type|time_offset)' + value,
                           sentence))


def _near(answer: Calibration, T: Array) -> bool:
    delta = se3.difference(answer.T_flange_sensor, T)
    return bool(np.linalg.norm(delta[:3]) < RIGHT and np.linalg.norm(delta[3:]) < 10 * RIGHT
                ) or trials.nees(answer.T_flange_sensor, answer.covariance, T) < LIKELY


def _solved(path: Path, config: Config) -> Calibration | str:
    try:
        recording = read_bag(path, config)
        return pipeline.calibrate(recording.profiles, recording.poses, config)
    except HandeyeError as error:
        return str(error)


def wrong_settings(arguments: argparse.Namespace) -> None:
    """Print the matrix of wrong settings."""
    names = [name for name in CELLS if arguments.only in name]
    jobs = [(name, seed) for name in names for seed in trials.seeds_of(arguments)]
    totals = np.zeros(3, dtype=int)
    for (name, _), cells in zip(jobs, trials.results(of_settings, jobs, arguments.workers),
                                strict=True):
        for changes, said, good, mended in cells:
            if not good or not mended:
                print(f'  {changes:50} {"" if good else "NOT NAMED "}'
                      f'{"" if mended else "NOT MENDED "}{said}')
        counts = len(cells), sum(cell[2] for cell in cells), sum(cell[3] for cell in cells)
        print(f'{name:28} {counts[0]:3} cells, {counts[1]:3} good, {counts[2]:3} mended',
              flush=True)
        totals += counts
    print('{} cells: {} good, {} mended'.format(*totals))


WHAT = {'bad': (bad, 52), 'moves': (moves, 20), 'settings': (wrong_settings, 1)}


def main() -> None:
    """Print the table that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('what', nargs='?', choices=WHAT, default='bad')
    trials.add_options(parser, 0)
    arguments = parser.parse_args()
    show, seeds = WHAT[arguments.what]
    arguments.seeds = arguments.seeds or seeds
    show(arguments)


if __name__ == '__main__':
    main()
