# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Files of measured values: whatever is in them, there is an answer or a sentence."""
from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from handeye_ros.tables import LENGTH, Table, TableError
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

CELLS = st.one_of(st.text(max_size=6), st.floats().map(repr), st.sampled_from(
    ['x [mm]', 'y [m]', 'x', '"', '\x00', '\r', '1e400', 'nan', '#', ';', ',', '[', '-']))
YAML = st.recursive(st.one_of(st.none(), st.booleans(), st.floats(), st.text(max_size=4)),
                    lambda inner: st.lists(inner, max_size=3), max_leaves=8)


def read(name: str, content: bytes) -> None:
    """Read a file; only TableError may be raised."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(content)
        try:
            values = Table(path).values('xy', LENGTH)
        except TableError as error:
            assert str(path) in str(error)
        else:
            assert values.shape[1] == 2 and np.isfinite(values).all()


@given(st.lists(st.lists(CELLS, max_size=4).map(','.join), max_size=5).map('\n'.join))
def test_any_csv(text: str) -> None:
    read('table.csv', text.encode('utf-8', 'surrogatepass'))


@given(st.binary(max_size=60))
def test_any_bytes(content: bytes) -> None:
    read('table.csv', content)
    read('table.yaml', content)


@given(YAML, YAML)
def test_any_yaml(columns: object, rows: object) -> None:
    read('table.yaml', f'columns: {columns!r}\nrows: {rows!r}\n'.encode('utf-8', 'ignore'))


def test_poses_as_a_controller_shows_them(tmp_path: Path) -> None:
    path = tmp_path / 'table.csv'
    path.write_text('f_x,f_y [m],f_z,f_a,f_b [rad],f_c\n10,0.02,30,90,0,0\n')
    T = Table(path).poses('f', 'kuka-abc')[0]
    np.testing.assert_allclose(T, [[0, -1, 0, 0.01], [1, 0, 0, 0.02], [0, 0, 1, 0.03],
                                   [0, 0, 0, 1]], atol=1e-12)
    with pytest.raises(TableError, match='has no column f_q1'):
        Table(path).poses('f', 'abb')


def test_values_are_in_si_units(tmp_path: Path) -> None:
    path = tmp_path / 'table.csv'
    path.write_text('\ufeff# remark\nx [mm];y[ um ]\n1;2\n\n-3.5; 4e3\n', encoding='utf-8')
    np.testing.assert_allclose(Table(path).values('xy', LENGTH), [[1e-3, 2e-6], [-3.5e-3, 4e-3]])
    with pytest.raises(TableError, match='has no column z'):
        Table(path).values('xyz', LENGTH)


@pytest.mark.parametrize(('name', 'text'), [
    ('a.yaml', 'columns: [x, y]\nrows: [[2020-13-45, 1]]'),
    ('a.yaml', f'columns: ["x [m]", "y [m]"]\nrows: [[1{"0" * 400}, 1]]'),
    ('a.csv', f'x [m],y [m]\n{"1" * 200000},2')])
def test_values_beyond_all_limits(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(TableError):
        Table(tmp_path / name).values('xy', LENGTH)
