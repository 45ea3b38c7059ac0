"""The settings that read a simulated recording."""
from __future__ import annotations

from typing import Any

from handeye_ros.simulate.layout import FRAMES
from handeye_ros.simulate.scenario import Scenario, SphereTarget


def settings(scenario: Scenario) -> dict[str, Any]:
    """Return the configuration, by dotted key, that reads the recordings of a scenario."""
    frame, target = FRAMES[scenario.layout.frame], scenario.target
    values: dict[str, Any] = {
        'calibration_type': scenario.calibration_type, 'target.type': scenario.scene,
        'profile.axes': list(frame.axes), 'profile.range_sign': frame.range_sign,
        'noise.sensor': scenario.sensor.noise,
        'noise.robot_translation': scenario.robot.repeatability[0],
        'noise.robot_rotation': scenario.robot.repeatability[1]}
    if isinstance(target, SphereTarget):
        values['target.radius'] = target.radius
    return values | dict(scenario.told)
