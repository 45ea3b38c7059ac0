# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Targets that are solved from files of measured values, one file each."""
from __future__ import annotations

from handeye_ros.config import Config
from handeye_ros.errors import BadValueError
from handeye_ros.tabulated.hand_eye import HAND_EYE
from handeye_ros.tabulated.method import FileMethod
from handeye_ros.tabulated.points import POINTS
from handeye_ros.tabulated.tracker import TRACKER

FILE_METHODS: dict[str, FileMethod] = {m.name: m for m in (POINTS, HAND_EYE, TRACKER)}


def of(config: Config) -> FileMethod | None:
    """
    Return the file method of a configuration, None for targets seen by profiles.

    Raises BadValueError for a method or a calibration type that it cannot be of.
    """
    method = FILE_METHODS.get(config.target.type)
    if method is None:
        return None
    for key, value, fitting in (('method', config.method, ('auto', method.name)),
                                ('calibration_type', config.calibration_type, method.mounts)):
        if value not in fitting:
            raise BadValueError(key, value, f'{" or ".join(fitting)} with target.type '
                                f'{method.name}')
    return method
