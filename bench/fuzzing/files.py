"""Files that are damaged, and what is asked of those who read them."""
from __future__ import annotations

from collections.abc import Callable
import contextlib
from pathlib import Path
from typing import Any

from fuzzing.damage import Case, damaged
from handeye_ros.bags import bag
from handeye_ros.bags.session_reading import read_session
from handeye_ros.config import Config, load
from handeye_ros.data import Array
from handeye_ros.errors import HandeyeError
from handeye_ros.results.calibration_file import read_calibration
from handeye_ros.results.truth_file import true_transform
from handeye_ros.tables import Table
import numpy as np


def bag_case(name: str) -> Case:
    """Return a case that reads a damaged recording, and scans it."""
    def case(rng: np.random.Generator, folder: Path) -> None:
        good = folder / 'good' / name
        file = folder / f'damaged{good.suffix}'
        file.write_bytes(damaged(good.read_bytes(), rng))
        with contextlib.suppress(HandeyeError):
            recording = bag.read(file, Config())
            assert recording.profiles and len(recording.poses)
            for profile in recording.profiles[:3]:
                with contextlib.suppress(HandeyeError):
                    profile.read()
        for _ in zip(bag.flow(file, Config()).profiles(), range(3), strict=False):
            pass
    return case


def metadata_case(rng: np.random.Generator, folder: Path) -> None:
    """Read a bag whose metadata.yaml is damaged."""
    text = (folder / 'good' / 'bag' / 'metadata.yaml').read_bytes()
    (folder / 'bag' / 'metadata.yaml').write_bytes(damaged(text, rng, text=True))
    assert bag.read(folder / 'bag', Config()).profiles


def text_case(name: str, read: Callable[[Path], Any]) -> Case:
    """Return a case that reads a damaged text file."""
    def case(rng: np.random.Generator, folder: Path) -> None:
        good = folder / 'good' / name
        file = folder / f'damaged{good.suffix}'
        file.write_bytes(damaged(good.read_bytes(), rng, text=True))
        read(file)
    return case


def truth_case(rng: np.random.Generator, folder: Path) -> None:
    """Read a damaged truth.yaml from beside its recording; what comes out is a transform."""
    text = (folder / 'good' / 'truth.yaml').read_bytes()
    file = folder / 'bag' / 'truth.yaml'
    file.write_bytes(damaged(text, rng, text=True))
    try:
        found = true_transform(folder / 'bag')
    finally:
        file.unlink()
    assert found is not None
    assert_transform(found)


def assert_transform(T: Array) -> None:
    """Raise AssertionError unless T (4, 4) moves and turns, no more."""
    R = T[:3, :3]
    assert T.shape == (4, 4) and np.isfinite(T).all() and (T[3] == [0, 0, 0, 1]).all()
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-6) and np.linalg.det(R) > 0


def check_calibration(file: Path) -> None:
    """Read a calibration; what comes out is a transform."""
    found = read_calibration(file)
    assert_transform(found.T_flange_sensor)
    assert np.isfinite(found.covariance).all()


def session_case(rng: np.random.Generator, folder: Path) -> None:
    """Read a session one file of which is damaged."""
    target = folder / 'session'
    files = sorted(target.iterdir())
    file = files[int(rng.integers(0, len(files)))]
    good = file.read_bytes()
    try:
        file.write_bytes(damaged(good, rng, text=file.suffix == '.yaml'))
        read_session(target).session(Config())
    finally:
        file.write_bytes(good)


FILES: dict[str, Case] = {
    'mcap': bag_case('small.mcap'), 'mcap, zstd': bag_case('zstd.mcap'),
    'db3': bag_case('small.db3'),
    'metadata.yaml': metadata_case,
    'calibration.yaml': text_case('calibration.yaml', check_calibration),
    'truth.yaml': truth_case,
    'CSV': text_case('tracker.csv', Table), 'config YAML': text_case('plate.yaml', load),
    'session': session_case}
