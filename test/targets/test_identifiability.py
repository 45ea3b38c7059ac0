# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The table of docs/estimator.md, of what each motion lets a method know, is what ranks say."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
import re

from cells import Cell, exact_cell
from handeye_ros.estimation.problem import Estimate, linearise, UNUSED
from handeye_ros.simulate import SCENARIOS
from handeye_ros.targets import METHODS
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

DOCUMENT = Path(__file__).parents[2] / 'docs' / 'estimator.md'
ROWS = {'general': 'general', 'one orientation': 'one_orientation',
        'one orientation per edge': 'one_orientation_per_edge',
        'tilts about the laser line only': 'tilt_only',
        'yaw about the face normal only': 'yaw_only'}
VALUES = {'line with its face': {'target__use_face': True}}
ZERO = 1e-8
WEDGE_TURNS = [np.pi / 2, 0.0]  # of a block's faces, z = 0 and y = 0, about its edge


def table() -> Iterator[tuple[str, str, int, int]]:
    """Yield motion, method, rank and number of unknowns of every cell of the table."""
    lines = DOCUMENT.read_text(encoding='utf-8').splitlines()
    start = next(i for i, text in enumerate(lines) if text.startswith('| motion | line'))
    header = re.findall(r'([a-z ]+?) /(\d+)', lines[start])
    for text in lines[start + 2:start + 2 + len(ROWS)]:
        motion, *ranks = [cell.strip() for cell in text.strip('|').split('|')]
        for (name, unknowns), rank in zip(header, ranks, strict=True):
            yield motion, name.strip(), int(rank), int(unknowns)


def at_truth(made: Cell) -> Estimate:
    T = made.truth.T_base_target
    radius = getattr(made.scenario.target, 'radius', 0.0)
    targets = {'plate': np.append(T.ravel(), [0.0, 0.0, np.pi / 2]),
               'line': T.ravel(), 'plane': T.ravel(),
               'sphere': np.append(T[:3, 3], radius),
               'wedge': np.append(T.ravel(), WEDGE_TURNS)}
    return Estimate(made.truth.T_flange_sensor, targets[made.problem.method.name])


def singular_values(name: str, motion: str) -> np.ndarray:
    """Return those of the derivatives by all unknowns, each column scaled to length 1."""
    method = name.split()[0]
    stations = (20, 20) if method == 'plate' else (40, 0)
    scenario = replace(SCENARIOS[method], motion=ROWS[motion], stations=stations)
    made = exact_cell(scenario, **VALUES.get(name, {}))
    problem, estimate = made.problem, at_truth(made)
    p = problem.points_in_base(estimate.X)
    observations = problem.method.relabel(problem.observations, p, estimate.target,
                                                   problem.config)
    used = observations.select(observations.kind != UNUSED)
    problem = replace(problem, observations=used)
    linear = linearise(problem, estimate)
    assert np.abs(linear.residuals).max() < 1e-9
    J = linear.jacobian[:, problem.columns]
    return np.linalg.svd(J / np.maximum(np.linalg.norm(J, axis=0), 1e-12), compute_uv=False)


def test_the_table_is_whole() -> None:
    cells = list(table())
    assert {motion for motion, *_ in cells} == set(ROWS)
    assert {name.split()[0] for _, name, *_ in cells} == set(METHODS)


@pytest.mark.parametrize(('motion', 'name', 'rank', 'unknowns'), list(table()))
def test_rank(motion: str, name: str, rank: int, unknowns: int) -> None:
    values = singular_values(name, motion)
    assert len(values) == unknowns
    assert int((values > ZERO).sum()) == rank


# The same from the equations alone: p = R (x r1 + z r3 + t) + a lies on the target. Nothing of
# the package is used, derivatives are differences.

ACROSS_P = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])  # square to the face and to edge p
ACROSS_Q = np.diag([1.0, -1, -1])
R_FLANGE_SENSOR, R_BASE_TARGET = Rotation.random(2, random_state=1).as_matrix()
T_FLANGE_SENSOR, T_BASE_TARGET = np.array([[0.05, -0.08, 0.12], [0.7, 0.2, 0.1]])
UNKNOWN = {'line': (1, 2, 4, 5), 'line with its face': (1, 2, 3, 4, 5), 'plane': (2, 3, 4),
           'plate': (0, 1, 2, 3, 4, 5)}  # of the target's translation and turn
ZEROS = {'p': (1, 2), 'q': (0, 2), 'face': (2,)}  # coordinates in the target


def measured(name: str, tilted: bool) -> list[tuple]:
    """
    Return R and a of the flange, a point of the sensor plane and what it is on.

    The sensor has one orientation, square to face and edge or tilted; the plate one per edge.
    """
    rng = np.random.default_rng(3)
    tilts = Rotation.from_euler('xyz', rng.uniform(-0.4, 0.4, (2, 3)) * tilted).as_matrix()
    rows = []
    for k in range(24):
        kind = {'plane': 'face', 'plate': 'pq'[k % 2]}.get(name, 'p')
        R_target_sensor = ACROSS_Q @ tilts[1] if kind == 'q' else ACROSS_P @ tilts[0]
        R = R_BASE_TARGET @ R_target_sensor @ R_FLANGE_SENSOR.T
        x, z, along, aside = rng.uniform([-0.02, 0.16, 0.03, 0.03], [0.02, 0.19, 0.12, 0.1])
        spot = {'p': [along, 0, 0], 'q': [0, along, 0], 'face': [along, aside, 0]}[kind]
        seen = np.array([x, 0, z])
        a = (R_BASE_TARGET @ (spot - R_target_sensor @ seen) + T_BASE_TARGET
             - R @ T_FLANGE_SENSOR)
        rows.append((R, a, seen, kind))
        if name != 'line':
            in_face = np.array([R_target_sensor[2, 2], 0, -R_target_sensor[2, 0]])
            rows.append((R, a, seen + 0.01 * in_face, 'face'))
    return rows


def distances(v: np.ndarray, rows: list[tuple]) -> np.ndarray:
    """Return what is zero at v = 0: turn and shift of the sensor, shift and turn of the target."""
    of_sensor, of_target = Rotation.from_rotvec([v[:3], v[9:]]).as_matrix()
    origin = T_BASE_TARGET + R_BASE_TARGET @ v[6:9]
    found = []
    for R, a, seen, kind in rows:
        p = R @ (of_sensor @ R_FLANGE_SENSOR @ seen + T_FLANGE_SENSOR + v[3:6]) + a
        found.append(((p - origin) @ R_BASE_TARGET @ of_target)[[*ZEROS[kind]]])
    return np.concatenate(found)


@pytest.mark.parametrize(('name', 'tilted', 'square'), [
    ('line', 7, 5), ('line with its face', 8, 6), ('plane', 5, 4), ('plate', 10, 7)])
def test_rank_of_one_orientation_from_the_equations_alone(
        name: str, tilted: int, square: int) -> None:
    assert ('one orientation per edge', name, tilted) in {row[:3] for row in table()}
    text = ' '.join(DOCUMENT.read_text(encoding='utf-8').split())
    assert f'{name} {square}' in text.split('Exactly square to the target')[1].split('.')[0]
    for rank, is_tilted in ((tilted, True), (square, False)):
        rows = measured(name, is_tilted)
        assert np.abs(distances(np.zeros(12), rows)).max() < 1e-12
        J = np.array([distances(h, rows) - distances(-h, rows) for h in 1e-4 * np.eye(12)]) / 2e-4
        J = J[[*range(6), *(6 + k for k in UNKNOWN[name])]]
        J = J / np.linalg.norm(J, axis=1, keepdims=True)
        assert int((np.linalg.svd(J, compute_uv=False) > 1e-5).sum()) == rank
