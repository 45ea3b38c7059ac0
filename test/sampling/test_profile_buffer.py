# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What is kept of the profiles of a stop never takes more than so much memory."""
from __future__ import annotations

from functools import partial

from handeye_ros.config import ProfileConfig
from handeye_ros.data import Profile, RawProfile
from handeye_ros.sampling.stops import ProfileBuffer
from hypothesis import given
from hypothesis import strategies as st
import numpy as np


def never(data: bytes, config: ProfileConfig) -> Profile:
    raise AssertionError('nothing is read')


def raw(stamp: int, size: int) -> RawProfile:
    return RawProfile(stamp, 'laser', partial(bytes, size), never, ProfileConfig(), size)


def test_the_oldest_are_dropped_first_and_counted() -> None:
    kept = ProfileBuffer(1000)
    for stamp in range(26):
        kept.add([raw(stamp, 100)])
    assert [p.stamp for p in kept.items] == list(range(16, 26))
    assert kept.dropped == 16 and 'the oldest of their stops' in kept.warning


def test_what_lies_in_a_file_takes_no_memory() -> None:
    kept = ProfileBuffer(1000)
    kept.add(raw(stamp, 0) for stamp in range(5000))
    kept.add([Profile(5000, 'laser', np.zeros((9, 2)))])
    assert len(kept.items) == 5001 and not kept.warning


@given(st.lists(st.tuples(st.integers(0, 400), st.integers(0, 30), st.integers(0, 30)),
                max_size=60))
def test_the_sum_is_that_of_what_is_kept(steps: list[tuple[int, int, int]]) -> None:
    kept = ProfileBuffer(1000)
    for stamp, (size, behind, ahead) in enumerate(steps):
        kept.add([raw(stamp, size)])
        assert sum(p.held for p in kept.items) <= 1000
        kept.keep(stamp - behind, stamp - behind + ahead)
        assert kept._bytes == sum(p.held for p in kept.items)
        assert all(stamp - behind <= p.stamp <= stamp - behind + ahead for p in kept.items)
