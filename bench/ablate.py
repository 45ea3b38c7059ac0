#!/usr/bin/env python3
"""
What each mechanism of the estimator is worth: it is switched off, one at a time.

usage: python bench/ablate.py [--seeds N] [--first S] [--sessions N] [--only TEXT] [--cells TEXT]
                              [--stations N]

A row per mechanism, over the same recordings: N of each of FAULTS in simulate/scenarios.py,
N of few samples, and some of each kind of bench/sessions.py.
  answered  of the cells with faults; TRE  mm, median and 90 %: error of mapped points
  NEES      mean squared error over the reported covariance: 6 when that is true
  in 95 %   the share of answers whose 95 % region holds the truth, and how many answers less or
            more than with all mechanisms, over the standard deviation of that difference
  few       the same two of few samples
  wrong     answers of bad sessions that are wrong; refused: good sessions that are refused
  s         CPU seconds of all solves
How to read it: a mechanism that changes none of the columns beyond chance is not needed.
"""
from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
import time

from handeye_ros import pipeline, se3
from handeye_ros.config import Config, with_values
from handeye_ros.errors import HandeyeError
from handeye_ros.estimation import noise, problem, search, solve
from handeye_ros.estimation.basis import process_root
from handeye_ros.estimation.covariance import Contamination
from handeye_ros.sampling.session import Session
from handeye_ros.simulate import FAULTS, Scenario, SCENARIOS, settings, simulate
from handeye_ros.simulate.recording import Simulated
import numpy as np
from physics import field, LIMIT, with_stations
from sessions import Kind, kinds, moved, outcome

Switch = tuple[object, str, object]
FEW = {f'{cell} {a} + {b}': replace(FAULTS[cell], stations=(a, b))
       for cell, counts in {
           'baseline': ((3, 3), (4, 3), (4, 4), (6, 5)), 'smooth 0.2 mm': ((4, 4), (6, 5)),
           'sphere': ((6, 0), (8, 0)), 'line': ((7, 0), (9, 0)), 'wedge': ((6, 0), (8, 0)),
           'plane': ((6, 0), (8, 0))}.items()
       for a, b in counts}


def without_blocks(*names: str) -> Switch:
    """Return the switch of the blocks whose names begin so."""
    every = solve.blocks_at

    def some(linear: object) -> tuple:
        return tuple(b for b in every(linear) if not b.name.startswith(names))
    return solve, 'blocks_at', some


def nobody(solved: solve.Solution, dropped: int) -> Contamination:
    """Return that no station of a solution is wrong."""
    n = len(solved.problem.poses)
    return Contamination(np.zeros(n), np.zeros((n, 6)), np.zeros((n, 6, 6)), np.ones(n))


MECHANISMS: dict[str, tuple[Switch, ...]] = {
    'all': (),
    'contamination': ((search, 'contamination', nobody),),
    'best-fit transform': ((solve, 'covering', lambda first, second: first),),
    'long errors in the report': (
        (problem, 'process_root', lambda poses, long_errors: process_root(poses)),),
    'MAP scales of their own': ((noise, 'MAP_PRIOR', noise.CONSERVATIVE_PRIOR),),
    'prior scales': ((solve, 'STEPS', 0), (solve, 'LAST_STEPS', 0)),
    'variance components': ((solve.Solution, 'factors', lambda self, *args: self.noise.factors),),
    'starts from subsets': ((search, 'SUBSETS', 0),),
    'graduated non-convexity': (
        (search, 'graduated', lambda start, squares, refit: refit(start, np.ones(
            len(squares(start))))),),
    'freed shape': ((pipeline, 'believable_shape', lambda problem, agreed, rng: agreed),),
    'one edge shape for all': (
        (pipeline, 'with_common_shape', list),),
    'set-back': (without_blocks('setback', 'incidence'),),
    'set-back by incidence': (without_blocks('incidence'),),
    'edge shape': (without_blocks('shape'),),
    'flatness': (without_blocks('flatness'),),
    'distortion': (without_blocks('distortion'),),
    'robot scale': (without_blocks('scale'),),
    'robot smooth error': (without_blocks('robot_'),),
}


@contextmanager
def switched_off(switches: tuple[Switch, ...]) -> Iterator[None]:
    """Replace what mechanisms consist of for a while."""
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in switches]
    for owner, name, value in switches:
        setattr(owner, name, value)
    try:
        yield
    finally:
        for owner, name, value in before:
            setattr(owner, name, value)


@dataclass(frozen=True)
class Recording:
    """A recording whose features are extracted, for all mechanisms alike."""

    scenario: Scenario
    config: Config
    made: Simulated
    seen: Session

    @classmethod
    def of(cls, name: str, scenario: Scenario, seed: int) -> Recording | None:
        """Return that of a scenario, None where it shows nothing."""
        config = with_values(Config(), settings(scenario), name)
        made = simulate(scenario, np.random.default_rng(seed))
        try:
            return cls(scenario, config, made, pipeline.gather(made.profiles, made.poses, config))
        except HandeyeError:
            return None

    def outcome(self) -> tuple[float, float]:
        """Return the error of mapped points (m) and the NEES, nan where it is refused."""
        try:
            answer = pipeline.solve_session(self.seen, self.config)
        except HandeyeError:
            return np.nan, np.nan
        X, true = answer.T_flange_sensor, self.made.truth.T_flange_sensor
        points, delta = field(self.scenario), se3.difference(X, true)
        off = se3.apply(X, points) - se3.apply(true, points)
        return (float(np.sqrt((off ** 2).sum(axis=1).mean())),
                float(delta @ np.linalg.solve(answer.covariance, delta)))


def figures(found: np.ndarray, every: np.ndarray) -> str:
    """Return answered, TRE, NEES, share inside, and the change of that in sigmas."""
    good = found[~np.isnan(found[:, 0])]
    inside, before = found[:, 1] < LIMIT, every[:, 1] < LIMIT
    change = int(inside.sum()) - int(before.sum())
    sigma = max(float((inside != before).sum()) ** 0.5, 1.0)
    tre = 1e3 * np.quantile(good[:, 0], [0.5, 0.9]) if len(good) else (np.nan, np.nan)
    return (f'{len(good):4}/{len(found):<4} {tre[0]:6.3f} {tre[1]:6.3f} {good[:, 1].mean():7.3g} '
            f'{100 * (good[:, 1] < LIMIT).mean():4.0f}% {change / sigma:+5.1f}')


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seeds', type=int, default=3)
    parser.add_argument('--first', type=int, default=0)
    parser.add_argument('--sessions', type=int, default=1, help='of each kind, 0: none')
    parser.add_argument('--only', default='', help='mechanisms, by parts of their names')
    parser.add_argument('--cells', default='', help='cells with this in their name')
    parser.add_argument('--stations', type=int, default=0, help='of cells with faults')
    arguments = parser.parse_args()
    faults = {name: with_stations(cell, arguments.stations) for name, cell in FAULTS.items()}
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    groups = [[found for name, scenario in cells.items() if arguments.cells in name
               for seed in seeds if (found := Recording.of(name, scenario, seed))]
              for cells in (faults, FEW)]
    every: list[np.ndarray] = []
    print(f'{"without":26} {"answered":>9} {"TRE, mm":>6} {"90 %":>6} {"NEES":>7} {"in 95":>5} '
          f'{"change":>5} | {"few: answered":>9} ...   wrong refused      s')
    for name, switches in MECHANISMS.items():
        if name != 'all' and not any(some in name for some in arguments.only.split(',')):
            continue
        start = time.process_time()
        with switched_off(switches):
            found = [np.array([r.outcome() for r in group]).reshape(-1, 2) for group in groups]
            seconds = time.process_time() - start
            wrong, refused = sessions_of(range(arguments.sessions))
        every = every or found
        cells = ' | '.join(figures(*pair) for pair in zip(found, every, strict=True)
                           if len(pair[0]))
        print(f'{name:26} {cells} | {wrong:5} {refused:7} {seconds:6.1f}', flush=True)


def sessions_of(seeds: range) -> tuple[int, int]:
    """Return how many bad sessions of each kind are answered wrongly, and good ones refused."""
    wrong = refused = 0
    few = [Kind(False, replace(SCENARIOS['plate'], stations=(a, b)),
                moved(k / (a + b), 1e-3 * d, False))
           for a, b, k in ((4, 3, 1), (4, 4, 1), (5, 5, 1), (5, 5, 2), (6, 6, 3))
           for d in (1, 3, 20)]
    for kind in (*kinds().values(), *few):
        for seed in seeds:
            refusal, off = outcome(kind, seed)
            wrong += not kind.good and not refusal and off
            refused += kind.good and bool(refusal)
    return wrong, refused


if __name__ == '__main__':
    main()
