"""A small run of bench/fuzz.py, and what it has found."""
from __future__ import annotations

from pathlib import Path
import sys

from handeye_ros.bags.session_reading import read_session
from handeye_ros.config import Config, load, with_assignments
from handeye_ros.errors import BagError, InputError
import pytest

sys.path.append(str(Path(__file__).parents[1] / 'bench'))

import fuzz  # noqa: E402, I100

CASES = fuzz.MESSAGES | fuzz.FILES


@pytest.fixture(scope='module')
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp('fuzz')
    fuzz.prepare(folder)
    return folder


@pytest.mark.filterwarnings('ignore:overflow encountered')
@pytest.mark.parametrize('kind', CASES)
def test_what_is_damaged_is_refused_or_read(folder: Path, kind: str) -> None:
    counts = {'PointCloud2': 400, 'PoseStamped': 400, 'session': 10}
    for number in range(counts.get(kind, 40)):
        fuzz.attempt(CASES[kind], 1, number, folder)


@pytest.mark.parametrize('text', ['[' * 3000, 'a: 2026-13-45', 'a: ' + '9' * 5000])
def test_yaml_that_its_parser_breaks_on_is_not_valid(tmp_path: Path, text: str) -> None:
    file = tmp_path / 'config.yaml'
    file.write_text(text)
    with pytest.raises(InputError):
        load(file)
    with pytest.raises(InputError):
        with_assignments(Config(), [f'name={text}'])


@pytest.mark.parametrize('at', [0.3, 0.5, 0.7])
def test_a_session_whose_file_is_damaged_is_refused_or_read(folder: Path, at: float) -> None:
    target = folder / 'good' / 'session'
    for file in sorted(target.glob('*.mcap')):
        whole = file.read_bytes()
        place = int(at * len(whole))
        try:
            for junk in (b'\xc3' * 30, b'\0' * 30, b'\xff' * 30):
                file.write_bytes(whole[:place] + junk + whole[place + 30:])
                try:
                    assert read_session(target).stops
                except (BagError, InputError) as error:
                    assert str(error)
        finally:
            file.write_bytes(whole)
