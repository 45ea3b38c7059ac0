# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Wrong values at the public door are refused by the name of the argument."""
from __future__ import annotations

from collections.abc import Callable

from handeye_ros import Config, gather, InputError, Profile, TimedPose
import numpy as np
import pytest

ORIGIN, NO_TURN = np.zeros(3), np.array([0.0, 0, 0, 1])


@pytest.mark.parametrize(('make', 'named'), [
    (lambda: Profile(1, 'laser', np.zeros((5, 3))), r'points of a profile is an array \(5, 3\)'),
    (lambda: Profile(1, 'laser', [[0.0, 0.1]]), 'points of a profile is a list'),
    (lambda: Profile(2.5, 'laser', np.zeros((5, 2))), 'stamp of a profile is 2.5'),
    (lambda: TimedPose(2e-9, ORIGIN, NO_TURN), 'stamp of a pose is 2e-09'),
    (lambda: TimedPose(1, np.zeros(2), NO_TURN), r'translation of a pose is an array \(2,\)'),
    (lambda: TimedPose(1, [0, 0, 0], NO_TURN), 'translation of a pose is a list'),
    (lambda: gather([], [TimedPose(1, ORIGIN * np.nan, NO_TURN)], Config()),
     'translation of a pose'),
    (lambda: gather([], [TimedPose(1, ORIGIN, 0 * NO_TURN)], Config()), 'quaternion of a pose')])
def test_wrong_input_is_refused_by_name(make: Callable[[], object], named: str) -> None:
    with pytest.raises(InputError, match=named):
        make()


def test_integers_of_numpy_are_stamps() -> None:
    assert TimedPose(np.int64(3), ORIGIN, NO_TURN).stamp == 3  # type: ignore[arg-type]
