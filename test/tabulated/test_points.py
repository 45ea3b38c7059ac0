# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Points in two frames: the truth, the best of 210 quadruples beaten, wrong input refused."""
from __future__ import annotations

from pathlib import Path

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import DataError, TooFewError
from handeye_ros.published import wu2017
from handeye_ros.tables import TableError
from handeye_ros.tabulated import points
import numpy as np
import pytest
from scipy.spatial.transform import Rotation


def cell(seed: int, noise: float = 0.0, count: int = 10, wrong: int = 0
         ) -> tuple[Array, Array, Array]:
    """Return T_base_camera and points (n, 3) in camera and base, the first ones wrong."""
    rng = np.random.default_rng(seed)
    T = se3.transform(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-1, 1, 3))
    base = rng.uniform(-0.15, 0.15, (count, 3)) + [0.6, 0.1, 0.3]
    camera = se3.apply(se3.inverse(T), base) + noise * rng.normal(size=(count, 3))
    camera[:wrong] += 5e-3 * rng.normal(size=(wrong, 3))
    return T, camera, base


@pytest.mark.parametrize('count', [4, 10, 60])
def test_the_truth_without_noise(count: int) -> None:
    T, camera, base = cell(count, count=count)
    found = points.solve(camera, base)
    assert np.abs(se3.difference(found.T_base_camera, T)).max() < 1e-9
    assert len(found.used) == count


def test_nearer_than_the_best_quadruple() -> None:
    ours, published = [], []
    for seed in range(50):
        T, camera, base = cell(seed, 3e-5)
        ours.append(np.abs(se3.difference(points.solve(camera, base).T_base_camera, T)))
        published.append(np.abs(se3.difference(wu2017.solve(camera, base).T_base_camera, T)))
    assert (np.median(ours, axis=0) < 0.9 * np.median(published, axis=0)).all()


def test_the_covariance_is_true_and_the_noise_found() -> None:
    squares, noise = [], []
    for seed in range(100):
        T, camera, base = cell(seed, 3e-5)
        found = points.solve(camera, base)
        delta = se3.difference(found.T_base_camera, T)
        squares.append(delta @ np.linalg.solve(found.covariance, delta) / 6)
        noise.append(found.noise)
    assert np.mean(squares) == pytest.approx(1.0, abs=0.25)
    assert np.median(noise) == pytest.approx(3e-5, rel=0.1)


def test_wrong_pairs_are_found_and_left_out() -> None:
    T, camera, base = cell(3, 3e-5, wrong=2)
    found = points.solve(camera, base)
    assert list(found.used) == list(range(2, 10))
    assert found.residuals[:2].min() > 1e-3 > 1e-4 > found.rms
    assert found.rms < found.holdout_rms < 3 * found.rms
    assert np.linalg.norm(se3.difference(found.T_base_camera, T)[3:]) < 1e-3


def test_what_cannot_carry_an_answer_is_refused() -> None:
    T, camera, base = cell(1)
    with pytest.raises(TooFewError, match='at least 4 points, got 3'):
        points.solve(camera[:3], base[:3])
    line = np.linspace(0.0, 1.0, 10)[:, None] * [0.1, 0.2, 0.3]
    with pytest.raises(DataError, match='in one line, so a turn about it is free'):
        points.solve(se3.apply(se3.inverse(T), line), line)
    with pytest.raises(DataError, match='same points in the same order'):
        points.solve(camera, base[::-1])


@pytest.mark.parametrize(('factor', 'words'), [
    ((1e3, 1), '1000 times smaller'), ((1e-3, 1), '1000 times larger'),
    ((1, 1e3), '1000 times larger'), ((1, 1e-3), '1000 times smaller')])
def test_a_wrong_unit_is_named(factor: tuple[float, float], words: str) -> None:
    _, camera, base = cell(1, 3e-5, wrong=1)
    with pytest.raises(DataError, match=f'{words} they fit: correct the unit'):
        points.solve(factor[0] * camera, factor[1] * base)


HEADER = 'camera_x [mm], camera_y [mm], camera_z [mm], base_x [m], base_y [m], base_z [m]'


def test_files_name_their_units(tmp_path: Path) -> None:
    T, camera, base = cell(2, count=5)
    rows = np.column_stack([1e3 * camera, base])
    csv, as_yaml = tmp_path / 'points.csv', tmp_path / 'points.yaml'
    csv.write_text(HEADER + '\n' + '\n'.join(', '.join(map(repr, r)) for r in rows.tolist()))
    names = ', '.join(f'"{name.strip()}"' for name in HEADER.split(','))
    as_yaml.write_text(f'columns: [{names}]\nrows: {rows.tolist()}\n')
    for path in (csv, as_yaml):
        found = points.solve(*points.read(path))
        assert np.abs(se3.difference(found.T_base_camera, T)).max() < 1e-9


@pytest.mark.parametrize(('text', 'message'), [
    (HEADER.replace(' [mm]', '', 1) + '\n1,2,3,4,5,6', 'camera_x names no unit; write camera_x '),
    (HEADER.replace('[mm]', '[inch]', 1) + '\n1,2,3,4,5,6', 'has the unit inch'),
    (HEADER.replace('base_z', 'bas_z') + '\n1,2,3,4,5,6', 'no column base_z; did you mean'),
    (HEADER.replace('base_z', 'base_y') + '\n1,2,3,4,5,6', 'two columns have the same name'),
    (HEADER + '\n1,2,3,4,5', 'row 1 has 5 values, the header 6'),
    (HEADER + '\n1,2,3,4,5,6\n1,2,x,4,5,6', 'row 2: camera_z is "x", expected a number'),
    (HEADER + '\n1,2,3,4,5,nan', 'row 1: base_z is "nan"'),
    (HEADER, 'holds no rows'), ('', 'is empty'), ('a b, c\n1,2', 'the column header "a b"')])
def test_files_that_cannot_be_read(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / 'points.csv'
    path.write_text(text)
    with pytest.raises(TableError) as caught:
        points.read(path)
    assert message in str(caught.value)


@pytest.mark.parametrize('text', ['a: [', 'rows: 3', 'columns: [x]\nrows: [3]', '- 1'])
def test_yaml_that_cannot_be_read(tmp_path: Path, text: str) -> None:
    path = tmp_path / 'points.yaml'
    path.write_text(text)
    with pytest.raises(TableError, match=r'points\.yaml: (cannot be read|expected "columns:")'):
        points.read(path)
    with pytest.raises(TableError, match='cannot be read'):
        points.read(tmp_path / 'missing.csv')
