# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Tables: an answer or a sentence; orientations as controllers show them."""
from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from handeye_ros.csv_tables import CsvTable, LENGTH, TableError
from handeye_ros.notations import notation_of, NOTATIONS
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

CELLS = st.one_of(st.text(max_size=6), st.floats().map(repr), st.sampled_from(
    ['x [mm]', 'y [m]', 'x', '"', '\x00', '\r', '1e400', 'nan', '#', ';', ',', '[', '-']))
LINES = st.lists(st.lists(CELLS, max_size=4).map(','.join), max_size=5).map('\n'.join)


@given(LINES.map(lambda text: text.encode('utf-8', 'surrogatepass')) | st.binary(max_size=60))
def test_any_file_is_read_or_refused(content: bytes) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / 'table.csv'
        path.write_bytes(content)
        try:
            values = CsvTable(path).values('xy', LENGTH)
        except TableError as error:
            assert str(path) in str(error)
        else:
            assert values.shape[1] == 2 and np.isfinite(values).all()


@pytest.mark.parametrize('micro', ['u', '\u00b5', '\u03bc'])
def test_values_are_in_si_units(tmp_path: Path, micro: str) -> None:
    path = tmp_path / 'table.csv'
    path.write_text(f'\ufeff# remark\nx [mm];y[ {micro}m ]\n1;2\n\n-3.5; 4e3\n', encoding='utf-8')
    values = CsvTable(path).values('xy', LENGTH)
    np.testing.assert_allclose(values, [[1e-3, 2e-6], [-3.5e-3, 4e-3]])


def test_poses_are_read_as_a_controller_shows_them(tmp_path: Path) -> None:
    path = tmp_path / 'table.csv'
    path.write_text('f_x,f_y [m],f_z,f_a,f_b [rad],f_c\n10,0.02,30,90,0,0\n')
    T = CsvTable(path).poses('f', 'kuka-abc')[0]
    np.testing.assert_allclose(T, [[0, -1, 0, 0.01], [1, 0, 0, 0.02], [0, 0, 1, 0.03],
                                   [0, 0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize(('text', 'message'), [
    ('', 'is empty'),
    ('x [m],y [m]', 'holds no rows'),
    ('a b, c\n1,2', 'the column header "a b"'),
    ('x [m],x [m]\n1,2', 'two columns have the same'),
    ('x [m],z [m]\n1,2', 'has no column y'),
    ('x,y [m]\n1,2', 'x names no unit; write'),
    ('x [m],y [inch]\n1,2', 'y has the unit inch'),
    ('x [m],y [rad]\n1,2', 'y has the unit rad'),
    ('x [m],y [m]\n1', 'row 1 has 1 value, the header 2'),
    ('x [m],y [m]\n1,2\n1,z', 'row 2: y is "z", expected a number'),
    ('x [m],y [m]\n1,nan', 'row 1: y is "nan"'),
    ('x [m],y [m]\n1,1_000', 'row 1: y is "1_000", expected a number'),
    ('x [m],y [m]\n1e30,2', 'row 1: x is "1e30", expected a number up to '),
    ('x [m],y [m]\n' + '1' * 200000 + ',2', 'cannot be read as CSV')])
def test_tables_that_cannot_be_read_are_refused_with_a_reason(tmp_path, text, message):
    (tmp_path / 'a.csv').write_text(text)
    with pytest.raises(TableError, match=message):
        CsvTable(tmp_path / 'a.csv').values('xy', LENGTH)


@pytest.mark.parametrize(('header', 'message'), [
    ('f_x [m],f_y [m]', r'has no column f_z$'),
    ('f_x [m],f_y [m],F_Z [m]', r'has no column f_z; did you mean "F_Z"'),
    ('f_x [m],f_y [m],f_z [m],f_qx,f_qy,f_qz', r'has no column f_qw$'),
    ('f_x,f_y,f_z,f_a,f_b,f_c', '; it has those that --angles kuka-abc reads, of the fl'),
    ('f_x [m],f_y [m],f_z [m],f_qx,f_qy,f_qz,f_qw', r'row 1: f_q... is no unit quaternion')])
def test_poses_without_all_columns_or_unit_length_are_refused(tmp_path, header, message):
    (tmp_path / 'a.csv').write_text(f'{header}\n' + ','.join('1' for _ in header.split(',')))
    with pytest.raises(TableError, match=message):
        CsvTable(tmp_path / 'a.csv').poses('f')


def test_poses_that_need_no_notation_are_told_so(tmp_path):
    (tmp_path / 'a.csv').write_text('f_x,f_y,f_z,f_roll,f_pitch,f_yaw\n1,1,1,1,1,1')
    with pytest.raises(TableError, match='those that are read without --angles'):
        CsvTable(tmp_path / 'a.csv').poses('f', 'kuka-abc')


def matrix(name: str, *numbers: float) -> np.ndarray:
    return notation_of(name).to_rotation(np.array([numbers]))[0].as_matrix()


def test_quaternions_of_abb_are_those_of_its_manual() -> None:
    """Example 1: z' = x; example 2: the tool turned by 30 degrees."""
    np.testing.assert_allclose(matrix('abb', 0.5 ** 0.5, 0, 0.5 ** 0.5, 0),
                               np.column_stack([[0, 0, -1], [0, 1, 0], [1, 0, 0]]), atol=1e-12)
    turned = Rotation.from_euler('y', [[30]], degrees=True)
    numbers = notation_of('abb').to_numbers(turned)
    np.testing.assert_allclose(numbers[0], [0.965926, 0, 0.258819, 0], atol=5e-7)


def test_rotation_vectors_of_universal_robots_are_those_of_their_manual() -> None:
    """rpy2rotvec([3.14, 1.57, 0]) and rotvec2rpy([3.14, 1.57, 0])."""
    R = Rotation.from_euler('xyz', [[3.14, 1.57, 0]])
    np.testing.assert_allclose(notation_of('ur').to_numbers(R)[0],
                               [2.22153, 0.00177, -2.21976], atol=6e-6)
    rpy = Rotation.from_matrix(matrix('ur', 3.14, 1.57, 0)).as_euler('xyz')
    np.testing.assert_allclose(rpy, [-2.80856, -0.16202, 0.9], atol=6e-6)


@pytest.mark.parametrize(('name', 'numbers', 'chain'), [
    ('kuka', (30, 90, 40), (('z', 30), ('y', 90), ('x', 40))),
    ('fanuc', (10, 20, 30), (('z', 30), ('y', 20), ('x', 10))),
    ('staubli', (10, 20, 30), (('x', 10), ('y', 20), ('z', 30))),
    ('yaskawa', (10, 20, 30), (('z', 30), ('y', 20), ('x', 10)))])
def test_angles_are_composed_as_the_manuals_define_them(name, numbers, chain):
    product = np.eye(3)
    for axis, angle in chain:
        product = product @ Rotation.from_euler(axis, angle, degrees=True).as_matrix()
    np.testing.assert_allclose(matrix(name, *numbers), product, atol=1e-12)


@pytest.mark.parametrize('name', NOTATIONS)
def test_orientations_of_every_notation_read_back(name: str) -> None:
    notation, R = NOTATIONS[name], Rotation.random(50, random_state=1)
    numbers = notation.to_numbers(R)
    assert numbers.shape == (50, len(notation.labels))
    np.testing.assert_allclose((notation.to_rotation(numbers).inv() * R).magnitude(), 0, atol=1e-9)
