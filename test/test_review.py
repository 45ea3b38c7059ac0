# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How well each stop agrees with an answer, also one that the answer does not use."""
from __future__ import annotations

from dataclasses import replace

from cells import recorded, set_to
from handeye_ros.pipeline import answer_session, gather
from handeye_ros.review import agreements
from handeye_ros.simulate import SCENARIOS
import pytest


def test_a_stop_left_out_agrees_as_one_that_is_used() -> None:
    """Of a rounded edge, which all stops of an answer are moved to."""
    plate = SCENARIOS['plate']
    rounded = recorded(replace(plate, target=replace(plate.target, rounding=1e-3)), rate=6.0)
    left_out = []
    for excluded in ([], [5]):
        config = set_to(rounded.config, samples__exclude=excluded)
        session = gather(rounded.profiles, rounded.poses, config)
        agreement = agreements(session, answer_session(session, config))[5]
        assert agreement.used == (not excluded)
        left_out.append(agreement.left_out)
    assert left_out[1] == pytest.approx(left_out[0], rel=0.1)
