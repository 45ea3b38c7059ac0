# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The recordings in bags/ are what tools/make_bags.py makes, whole and small."""
from __future__ import annotations

from pathlib import Path

from handeye_ros.bags import bag
from handeye_ros.config import Config, flatten, load
from handeye_ros.data import Array
from handeye_ros.results.truth_file import true_transform
from handeye_ros.simulate import FILE_SCENES, SCENARIOS, simulate
import numpy as np
import pytest
import yaml

BAGS = Path(__file__).parents[2] / 'bags'
NAMES = ('plate', 'plate_sweep', 'sphere', 'one_orientation', 'inverted_poses', 'line', 'plane',
         'tracker')


def in_order(points: Array) -> Array:
    """Return the points along the line, as a cloud of scattered ones is read."""
    seen = points[np.isfinite(points).all(axis=1)]
    return seen[np.argsort(seen[:, 0])]


@pytest.mark.parametrize('name', NAMES)
def test_a_bag_holds_what_its_truth_says_it_was_made_from(name: str) -> None:
    truth = yaml.safe_load((BAGS / name / 'truth.yaml').read_text(encoding='utf-8'))
    rng, scenario = np.random.default_rng(truth['seed']), truth['scenario']
    made = FILE_SCENES[scenario](rng) if name == 'tracker' else simulate(SCENARIOS[scenario], rng)
    T_true = made.T_flange_sensor if name == 'tracker' else made.truth.T_flange_sensor
    assert np.allclose(true_transform(BAGS / name), T_true, atol=1e-9)
    read = bag.read(BAGS / name, Config())
    assert not read.warnings
    for raw, here in zip(read.profiles, made.profiles, strict=True):
        there = raw.read()
        assert there.stamp == here.stamp
        # single precision; another numpy may round a coordinate to the next step
        points = here.points if len(there.points) == len(here.points) else in_order(here.points)
        assert np.allclose(there.points, points, rtol=0, atol=2e-6, equal_nan=True)
    for there, here in zip(read.poses, made.poses, strict=True):
        assert there.stamp == here.stamp
        assert np.allclose(there.translation, here.translation, rtol=0, atol=1e-9)
        assert np.allclose(there.quaternion, here.quaternion, rtol=0, atol=1e-9)


def test_the_reflector_of_the_tracker_is_what_its_truth_says() -> None:
    truth = yaml.safe_load((BAGS / 'tracker' / 'truth.yaml').read_text(encoding='utf-8'))
    rng = np.random.default_rng(truth['seed'])
    made = FILE_SCENES[truth['scenario']](rng).tables['tracker.csv']
    there = (BAGS / 'tracker' / 'tracker.csv').read_text(encoding='utf-8')
    for line, other in zip(there.splitlines(), made.splitlines(), strict=True):
        (kind, *values), (other_kind, *others) = line.split(', '), other.split(', ')
        assert kind == other_kind
        if kind != 'kind':
            assert np.allclose(np.array(values, float), np.array(others, float), atol=1e-6)
    config = load(BAGS.parent / 'config' / 'tracker.yaml')
    assert {key: flatten(config)[key] for key in truth['settings']} == truth['settings']


def test_the_bags_are_small_and_explained() -> None:
    assert sum(file.stat().st_size for file in BAGS.rglob('*') if file.is_file()) < 5e6
    folders = {path.name for path in BAGS.iterdir() if path.is_dir()}
    explained = (BAGS / 'README.md').read_text(encoding='utf-8')
    assert folders == {*NAMES, 'arm'} and all(f'`{name}`' in explained for name in folders)
