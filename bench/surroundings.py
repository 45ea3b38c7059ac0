#!/usr/bin/env python3
"""
What other surfaces and other ends beside the target do to the answer.

usage: python bench/surroundings.py [--seeds N] [--first S] [--only TEXT] [--refusals] [--alone]

A row per cell, over N recordings: how many are answered, TRE (mm, median and worst: RMS error of
points mapped from the field of view, against the truth), the share of the answers whose stated
95 % region holds the truth, and what most of the others are refused as. The cells:
  plane    target.type plane, and a plate on a table whose edge most stations cross;
           --alone: the same recordings without the other surface; off centre: of a plate of 120 mm
           that the sensor is aimed up to 90 mm beside the middle of, where it sees the table alone
  line     target.type line on a corner of a block, seen by a sensor that is so wide that a face
           also ends where its reach does; every other station is turned around
  wedge    a block on a table, whose foot makes a groove in many profiles; stepped: with a step
           along its edge, which makes a second edge of two faces parallel to the first
"""
from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import replace
import math
from typing import Any

from handeye_ros import pipeline, se3
from handeye_ros.config import Config, with_values
from handeye_ros.errors import HandeyeError
from handeye_ros.results.truth_file import errors_against
from handeye_ros.simulate import FAULTS, Scenario, settings, simulate
from handeye_ros.simulate.scenario import Layout, PlateTarget, WedgeTarget
from handeye_ros.simulate.scenes import SCENES
from handeye_ros.simulate.solids import Box, Solid
from handeye_ros.simulate.stations import lift, Stops
import numpy as np
from physics import field
from scipy.stats import chi2

LIMIT = chi2.ppf(0.95, 6)
ON_TABLE, TURNED, OFF_CENTRE = 'wedge on a table', 'wedge, turned around', 'plane off centre'
STEPPED = 'stepped wedge'
STEP = (0.010, 0.003)  # its width and depth (m)
PLATE, WEDGE = FAULTS['baseline'], FAULTS['wedge']


def with_table(scenario: Scenario) -> tuple[Solid, ...]:
    """Return the block of a wedge, and the table that it stands on."""
    width = scenario.target.width
    return (*SCENES['wedge'].solids(scenario),
            Box((-1.0, -1.0, -width - 0.02), (1.0, 1.0, -width)))


def with_step(scenario: Scenario) -> tuple[Solid, ...]:
    """Return a block with a step along its edge."""
    (length, width), (wide, deep) = (scenario.target.length, scenario.target.width), STEP
    return (Box((0.0, wide, -width), (length, width, 0.0)),
            Box((0.0, 0.0, -width), (length, width, -deep)))


def turned_around(scenario: Scenario, rng: np.random.Generator) -> Stops:
    """Return stops at a wedge, every other one turned by half a turn about its range axis."""
    at = SCENES['wedge'].stops(scenario, rng)
    T, points = at.T_target_sensor.copy(), at.points.copy()
    turn = np.diag([-1.0, -1.0, 1.0])
    for k in range(0, len(T), 2):
        spot = T[k, :3, :3] @ lift(points[k]) + T[k, :3, 3]
        T[k, :3, :3] = T[k, :3, :3] @ turn
        T[k, :3, 3] = spot - T[k, :3, :3] @ lift(points[k])
    return Stops(T, at.labels, points)


def off_centre(scenario: Scenario, rng: np.random.Generator) -> Stops:
    """Return stops with the sensor aimed up to 90 mm beside the middle of a plate, each way."""
    at = SCENES['plane'].stops(scenario, rng)
    T, middle = at.T_target_sensor.copy(), np.array(scenario.target.size) / 2
    spots = (T[:, :3, :3] @ lift(at.points)[:, :, None])[:, :, 0] + T[:, :3, 3]
    T[:, :2, 3] += middle + rng.uniform(-0.09, 0.09, (len(T), 2)) - spots[:, :2]
    return Stops(T, at.labels, at.points)


SCENES[OFF_CENTRE] = replace(SCENES['plane'], stops=off_centre)
SCENES[ON_TABLE] = replace(SCENES['wedge'], solids=with_table)
SCENES[STEPPED] = replace(SCENES['wedge'], solids=with_step)
SCENES[TURNED] = replace(SCENES['wedge'], stops=turned_around)


def cell(name: str, base: Scenario, kind: str, **values: Any) -> Scenario:
    """Return a cell whose target is told to be one of some type."""
    return replace(base, name=name, stated=(('target.type', kind),), **values)


def cells() -> dict[str, Scenario]:
    """Return the cells by name."""
    found = []
    for table in (0.003, 0.010, 0.025):
        plate = replace(PLATE.target, table=table)
        found.append(cell(f'plane, table {table * 1e3:.0f} mm below', PLATE, 'plane',
                          target=plate, stations=(9, 9)))
    for step in (0.002, 0.010):
        plate = replace(PLATE.target, table=None, clutter=step, clutter_gap=0.003,
                        clutter_width=0.06)
        found.append(cell(f'plane, step {step * 1e3:.0f} mm up', PLATE, 'plane', target=plate,
                          stations=(9, 9)))
    found.append(cell('plane, small plate on a table', replace(PLATE, scene='plane'), 'plane',
                      target=PlateTarget((0.06, 0.05), table=0.010), stations=(18, 0)))
    for count in (12, 18, 24):
        found.append(cell(f'plane off centre, {count}', replace(PLATE, scene=OFF_CENTRE), 'plane',
                          target=PlateTarget((0.12, 0.12), thickness=0.003, table=0.003),
                          stations=(count, 0)))
    wide = FAULTS['sphere'].sensor
    for sensor, what in ((WEDGE.sensor, ''), (wide, ', wide')):
        for width in (0.03, 0.2):
            found.append(cell(f'line, corner of {width * 1e3:.0f} mm{what}', WEDGE, 'line',
                              sensor=sensor, layout=Layout(no_return='omit'), scene=TURNED,
                              target=WedgeTarget(width=width), stations=(24, 0)))
    for width in (0.010, 0.015, 0.025):
        for tilt in (20, 35):
            found.append(cell(f'wedge, {width * 1e3:.0f} mm over a table, tilt {tilt}', WEDGE,
                              'wedge', scene=ON_TABLE, tilt=math.radians(tilt),
                              target=WedgeTarget(width=width), stations=(22, 0)))
    found.append(cell('wedge, stepped by 10 and 3 mm', WEDGE, 'wedge', scene=STEPPED,
                      target=WedgeTarget(width=0.05), stations=(18, 0)))
    return {scenario.name: scenario for scenario in found}


def trial(scenario: Scenario, seed: int) -> tuple[float, float] | str:
    """Return the mapped error (m) and the squared error by the covariance, or the refusal."""
    recording = simulate(scenario, np.random.default_rng(seed))
    config = with_values(Config(), settings(scenario), scenario.name)
    try:
        answer = pipeline.calibrate(recording.profiles, recording.poses, config)
    except HandeyeError as error:
        return f'{type(error).__name__}: {error}'
    X, X_true = answer.T_flange_sensor, recording.truth.T_flange_sensor
    delta = se3.difference(X, X_true)
    return (errors_against(X, X_true, field(scenario)).mapped_points,
            float(delta @ np.linalg.solve(answer.covariance, delta)))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--seeds', type=int, default=20)
    parser.add_argument('--first', type=int, default=0, help='the first seed')
    parser.add_argument('--only', default='', help='cells whose name holds this text')
    parser.add_argument('--refusals', action='store_true', help='print every refusal')
    parser.add_argument('--alone', action='store_true', help='no other surfaces (plane)')
    arguments = parser.parse_args()
    print(f'{"cell":36} answered  TRE    worst  in 95 %  most are refused as')
    for name, scenario in cells().items():
        if arguments.only not in name:
            continue
        if arguments.alone and isinstance(scenario.target, PlateTarget):
            scenario = replace(scenario, target=replace(scenario.target, table=None, clutter=None))
        outcomes = [trial(scenario, seed) for seed in range(
            arguments.first, arguments.first + arguments.seeds)]
        refused = [o for o in outcomes if isinstance(o, str)]
        good = np.array([o for o in outcomes if not isinstance(o, str)]).reshape(-1, 2)
        text = f'{name:36} {len(good):3}/{len(outcomes):<3}'
        if len(good):
            text += (f' {1e3 * np.median(good[:, 0]):6.3f} {1e3 * good[:, 0].max():6.3f}'
                     f' {(good[:, 1] < LIMIT).mean():7.0%}')
        kinds = Counter(o.partition(':')[0] for o in refused).most_common(1)
        print(text, *(f' {count} x {kind}' for kind, count in kinds), flush=True)
        for o in refused if arguments.refusals else ():
            print(f'    {o}')


if __name__ == '__main__':
    main()
