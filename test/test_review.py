# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""How well each stop agrees with an answer, also one that the answer does not use."""
from __future__ import annotations

from dataclasses import replace

from cells import recorded, set_to
from handeye_ros.pipeline import answer_session, gather
from handeye_ros.review import agreements, samples_table
from handeye_ros.simulate import SCENARIOS
import numpy as np
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


def test_a_stop_whose_pose_is_wrong_is_compared_with_the_answer_of_the_others() -> None:
    """It is not used, and stands first in the table, with how far it is off."""
    plate = recorded('plate', rate=6.0)
    stop = gather(plate.profiles, plate.poses, plate.config).stops[4]
    shift = np.array([0.0, 0.0, 0.02])
    poses = [replace(pose, translation=pose.translation + shift)
             if stop.start <= pose.stamp <= stop.end else pose for pose in plate.poses]
    session = gather(plate.profiles, poses, plate.config)
    answer = answer_session(session, plate.config)
    agreement_of_stop = agreements(session, answer)
    wrong = agreement_of_stop.pop(stop.number)
    assert not wrong.used and wrong.residual == wrong.left_out > 2e-3
    assert all(good.used and good.residual < good.left_out < 1e-3
               for good in agreement_of_stop.values())
    numbers, _, _, states, _ = ([str(cell) for cell in column.cells]
                                for column in samples_table(session, answer).columns)
    assert numbers[0] == str(stop.number)
    assert [*filter(None, states)] == ['not used'] == states[:1]


def test_without_an_answer_no_stop_agrees_and_the_table_names_them_all() -> None:
    plate = recorded('plate', rate=6.0)
    config = set_to(plate.config, samples__exclude=[*range(4, 100)])
    session = gather(plate.profiles, plate.poses, config)
    answer = answer_session(session, config)
    assert answer.calibration is None and agreements(session, answer) == {}
    numbers, residuals, *_, states, _ = ([str(cell) for cell in column.cells]
                                         for column in samples_table(session, answer).columns)
    assert numbers == [str(stop.number) for stop in session.stops]
    assert not any(residuals) and states == [
        'excluded' if session.excludes(stop) else '' for stop in session.stops]
