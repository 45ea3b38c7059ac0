"""The settings that a calibration was made with, which also read today's recordings."""
from __future__ import annotations

from collections.abc import Mapping

from handeye_ros.config import Config, parameters, with_values
from handeye_ros.data import Calibration
from handeye_ros.errors import BadValueError


def settings_of(calibration: Calibration) -> Config:
    """Return the configuration that a calibration holds; keys that are no longer known go."""
    values = calibration.provenance.get('config', {})
    known = {parameter.key for parameter in parameters()}
    config = Config()
    for key, value in values.items() if isinstance(values, Mapping) else ():
        if key in known:
            try:
                config = with_values(config, {key: value}, 'the calibration')
            except BadValueError:
                continue  # written by a version that knew more
    return config
