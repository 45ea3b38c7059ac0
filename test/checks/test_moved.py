"""A target or sensor that moved in the middle of a recording is named."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import re

from cells import cell
from handeye_ros import pipeline, se3
from handeye_ros.checks.errors import MovedError
from handeye_ros.data import Array, Sample
from handeye_ros.errors import DataError
import numpy as np
import pytest

pytestmark = pytest.mark.thorough

OTHER_TOOL = se3.perturb(np.eye(4), np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.2]))
BUMPED = se3.perturb(np.eye(4), np.array([0.004, 0.002, 0.0, 0.0, 0.0, 0.01]))


def later(samples: tuple[Sample, ...], change: Callable[[Array], Array]) -> list[Sample]:
    """Return samples in the order of time, the poses of the second half changed."""
    ordered = sorted(samples, key=lambda sample: sample.stamp)
    half = len(ordered) // 2
    return ordered[:half] + [replace(s, T_base_flange=change(s.T_base_flange))
                             for s in ordered[half:]]


@pytest.mark.parametrize('name', ['plate', 'sphere'])
@pytest.mark.parametrize(('change', 'words'), [
    (lambda T: T @ OTHER_TOOL, 'the sensor moved in flange by 5'),
    (lambda T: BUMPED @ T, 'the target moved in base, or'),
])
def test_what_moved_is_named(name: str, change: Callable[[Array], Array], words: str) -> None:
    made = cell(name, 3)
    with pytest.raises(MovedError, match=words) as caught:
        pipeline.solve(later(made.samples, change), [], made.config, 'laser')
    parted = re.search(r'the first (\d+) samples .* the other (\d+),', str(caught.value))
    first, rest = map(int, parted.groups())
    n = len(made.samples)
    assert first + rest == n and abs(first - n // 2) <= 2


def test_with_the_sensor_beside_the_robot_the_frames_change_sides() -> None:
    made = cell('eye_on_base', 3)
    with pytest.raises(MovedError, match='the target moved in flange, or'):
        pipeline.solve(later(made.samples, lambda T: T @ OTHER_TOOL), [], made.config, 'laser')


def test_samples_that_contradict_each_other_anyhow_are_not_called_moved() -> None:
    made = cell('plate', 3)
    poses = np.roll([s.T_base_flange for s in made.samples], 1, axis=0)
    samples = [replace(s, T_base_flange=T) for s, T in zip(made.samples, poses, strict=True)]
    with pytest.raises(DataError) as caught:
        pipeline.solve(samples, [], made.config, 'laser')
    assert not isinstance(caught.value, MovedError)
