"""The frame of the profiles: one of the robot's is refused, whatever the robot calls it."""
from __future__ import annotations

from dataclasses import replace

from cells import cell
from handeye_ros import pipeline
from handeye_ros.checks.errors import SensorFrameError
import pytest


@pytest.mark.parametrize(('frame', 'key'), [
    ('flange', 'robot_effector_frame'), ('base', 'robot_base_frame')])
def test_a_frame_of_the_robot_is_refused_by_its_key(frame: str, key: str) -> None:
    made = cell('sphere')
    with pytest.raises(SensorFrameError, match=f'"{frame}", and {key} is the same'):
        pipeline.solve(made.samples, [], made.config, frame)
    other = replace(made.config, **{key: 'tool0'})
    assert pipeline.solve(made.samples, [], other, frame).child_frame == frame
