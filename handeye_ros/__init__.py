# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Hand-eye calibration of laser line profilers, offline and as a ROS 2 node.

What a user of the library imports is named here; docs/library.md shows it at work. A name is
imported where it is first used, so that `import handeye_ros` costs nothing.
"""
from __future__ import annotations

from contextlib import suppress
from functools import cache
from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from handeye_ros.bags.recording import read_bag
    from handeye_ros.config import Config, with_values
    from handeye_ros.config import load as load_config
    from handeye_ros.data import Calibration, Profile, Reject, Sample, TimedPose
    from handeye_ros.errors import DataError, HandeyeError, InputError
    from handeye_ros.pipeline import calibrate, gather, solve
    from handeye_ros.results.calibration_file import read_calibration, write_calibration
    __version__: str

__all__ = [
    'calibrate', 'Calibration', 'Config', 'DataError', 'gather', 'HandeyeError', 'InputError',
    'load_config', 'Profile', 'read_bag', 'read_calibration', 'Reject', 'Sample', 'solve',
    'TimedPose', 'with_values', 'write_calibration',
]

_HOMES = {
    **dict.fromkeys(('Config', 'load_config', 'with_values'), 'config'),
    **dict.fromkeys(('Calibration', 'Profile', 'Reject', 'Sample', 'TimedPose'), 'data'),
    **dict.fromkeys(('DataError', 'HandeyeError', 'InputError'), 'errors'),
    **dict.fromkeys(('calibrate', 'gather', 'solve'), 'pipeline'),
    **dict.fromkeys(('read_calibration', 'write_calibration'), 'results.calibration_file'),
    'read_bag': 'bags.recording'}


@cache
def __getattr__(name: str) -> Any:
    if name == '__version__':  # it stands in package.xml, and comes here by the installation
        from importlib.metadata import PackageNotFoundError, version
        with suppress(PackageNotFoundError):
            return version(__name__)
        return 'unknown'
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    name_there = 'load' if name == 'load_config' else name
    return getattr(import_module(f'{__name__}.{_HOMES[name]}'), name_there)
