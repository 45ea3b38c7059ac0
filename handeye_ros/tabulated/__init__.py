# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Targets that are solved from files of measured values, one file each."""
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from handeye_ros.config import Config
from handeye_ros.errors import BadValueError
from handeye_ros.tabulated import hand_eye, points, tracker
from handeye_ros.tabulated.values import Input, Values

READERS: dict[type[Values], Callable[[Path, Config], Input]] = {
    points.Pairs: points.read, hand_eye.Views: hand_eye.read, tracker.TrackerSession: tracker.read}
FILE_TARGETS = {values.name: values for values in READERS}


def is_solved_from_files(config: Config) -> bool:
    """
    Return whether a configuration is of a target that is solved from files.

    Raises BadValueError for a method or a calibration type that it cannot be of.
    """
    values = FILE_TARGETS.get(config.target.type)
    if values is None:
        return False
    for key, value, fitting in (('method', config.method, ('auto', values.name)),
                                ('calibration_type', config.calibration_type, values.mounts)):
        if value not in fitting:
            raise BadValueError(key, value, f'{" or ".join(fitting)} with target.type '
                                f'{values.name}')
    return True


def read(path: Path, config: Config) -> Input:
    """Return the values of the configuration's target in a file; raises InputError, DataError."""
    return READERS[FILE_TARGETS[config.target.type]](path, config)
