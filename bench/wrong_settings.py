#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What is said of a recording that is read with a wrong setting: the matrix of causes and refusals.

usage: python bench/wrong_settings.py [--seed S] [--only TEXT] [--verbose]

A recording of each target is read with each wrong setting. A cell is good where the first sentence
names a setting that is wrong with its right value, or where the answer is right all the same (a
plate has planes and straight edges); it is mended where the advice, obeyed up to three times,
leads to a right answer. Prints the cells that are not, a row per recording, and the sums.
"""
from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
import re
import tempfile

from handeye_ros import pipeline, se3
from handeye_ros.bags import bag, bag_write
from handeye_ros.config import Config, with_assignments, with_values
from handeye_ros.data import Calibration
from handeye_ros.errors import HandeyeError
from handeye_ros.simulate import FAULTS, SCENARIOS, settings, simulate
import numpy as np

CELLS = ('baseline', 'sphere', 'line', 'plane', 'wedge', 'plate, wide off-centre',
         'sphere, wide off-centre', 'line, wide off-centre', 'wedge, wide off-centre',
         'plane, wide off-centre', 'eye_on_base')
LIKELY = 22.5  # NEES of six numbers, that right ones exceed in one of 1000
TARGETS = ('plate', 'sphere', 'line', 'plane', 'wedge')
AXES = ('[x, z]', '[z, x]', '[y, z]', '[x, y]', '[z, y]', '[y, x]')
RIGHT = 2e-3  # m or 10 times as many rad: nearer than this no setting is wrong


def wrong(right: dict[str, str]) -> Iterator[dict[str, str]]:
    """Yield settings that are wrong, and what is done to the poses."""
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


def main() -> None:
    """Print the matrix."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--only', default='', help='recordings whose name holds this text')
    parser.add_argument('--verbose', action='store_true', help='print what is said in every cell')
    arguments = parser.parse_args()
    totals = np.zeros(3, dtype=int)
    for name in CELLS:
        if arguments.only in name:
            totals += _row(name, arguments.seed, arguments.verbose)
    cells, named, followed = totals.tolist()
    print(f'{cells} cells: {named} good, {followed} mended')


def _row(name: str, seed: int, verbose: bool) -> tuple[int, int, int]:
    scenario = FAULTS.get(name) or SCENARIOS[name]
    right = {'profile.axes': '[x, z]', 'profile.range_sign': '1', 'profile.unit': 'm',
             'time_offset': '0.0'} | {
        key: f'[{", ".join(value)}]' if isinstance(value, list) else str(value)
        for key, value in settings(scenario).items()}
    results = []
    with tempfile.TemporaryDirectory() as folder:
        path, made = Path(folder) / 'bag', simulate(scenario, np.random.default_rng(seed))
        bag_write.write(path, made.profiles, made.poses, truth={})
        for changes in wrong(right):
            config = with_values(Config(), settings(scenario), 'bench')
            said, good, obeyed = _cell(path, config, changes, right,
                                       made.truth.T_flange_sensor)
            results.append((good, obeyed))
            if verbose or not good or not obeyed:
                print(f'  {_text(changes):50} {"" if good else "NOT NAMED "}'
                      f'{"" if obeyed else "NOT MENDED "}{said}', flush=True)
    found = np.array(results)
    print(f'{name:28} {len(found):3} cells, {found[:, 0].sum():3} good, {found[:, 1].sum():3} '
          'mended', flush=True)
    return len(found), int(found[:, 0].sum()), int(found[:, 1].sum())


def _cell(path: Path, config: Config, changes: dict[str, str], right: dict[str, str], T: np.ndarray
          ) -> tuple[str, bool, bool]:
    """Return what is said with wrong settings, whether it is good, and whether to obey helps."""
    config = with_assignments(config, [f'{k}={v}' for k, v in changes.items()])
    answer = _solved(path, config)
    if isinstance(answer, Calibration):
        good = _near(answer, T)
        return 'answered' + ('' if good else ', wrong'), good, good
    sentence = answer.split(': check')[0]
    first = _advice(sentence)
    for _ in range(3):  # one advice after the other
        if not (advice := _advice(answer)):
            break
        config = with_assignments(config, [f'{k}={v}' for k, v in advice.items()])
        answer = _solved(path, config)
        if isinstance(answer, Calibration):
            break
    mended = isinstance(answer, Calibration) and _near(answer, T)
    # a plane may be meant where a line was recorded: the setting is named, and both are right
    good = any(first.get(key) == right[key] or (key in first and mended) for key in changes)
    return sentence, good, mended


def _advice(sentence: str) -> dict[str, str]:
    """Return the values that a refusal says are to be set."""
    value = r'(?: to)? (\[[^]]*\]|-?\d+(?:\.\d+)?|eye_\w+|m+\b|' + '|'.join(TARGETS) + ')'
    return dict(re.findall(r'(target\.type|profile\.\w+|calibration_type|time_offset)' + value,
                           sentence))


def _near(answer: Calibration, T: np.ndarray) -> bool:
    delta = se3.difference(answer.T_flange_sensor, T)
    return bool(np.linalg.norm(delta[:3]) < RIGHT and np.linalg.norm(delta[3:]) < 10 * RIGHT
                ) or bool(delta @ np.linalg.solve(answer.covariance, delta) < LIKELY)


def _text(changes: dict[str, str]) -> str:
    return ', '.join(f'{key}={value}' for key, value in changes.items())


def _solved(path: Path, config: Config) -> Calibration | str:
    try:
        recording = bag.read(path, config)
        return pipeline.calibrate(recording.profiles, recording.poses, config)
    except HandeyeError as error:
        return str(error)


if __name__ == '__main__':
    main()
