# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Hand-eye calibration of laser line profilers, offline and as a ROS 2 node.

What a user of the library imports is named here; docs/library.md shows it at work. A name is
imported where it is first used, so that `import handeye_ros` costs nothing.
"""
from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from handeye_ros.bags.bag import read as read_bag
    from handeye_ros.config import Config, with_values
    from handeye_ros.config import load as load_config
    from handeye_ros.data import Calibration, Profile, Reject, Sample, TimedPose
    from handeye_ros.errors import DataError, HandeyeError, InputError
    from handeye_ros.pipeline import calibrate, gather, solve
    from handeye_ros.results.calibration_file import read_calibration, write_calibration

__all__ = [
    'calibrate', 'Calibration', 'Config', 'DataError', 'gather', 'HandeyeError', 'InputError',
    'load_config', 'Profile', 'read_bag', 'read_calibration', 'Reject', 'Sample', 'solve',
    'TimedPose', 'with_values', 'write_calibration',
]

_HOMES = {
    'config': {'Config': 'Config', 'load_config': 'load', 'with_values': 'with_values'},
    'data': {name: name for name in ('Calibration', 'Profile', 'Reject', 'Sample', 'TimedPose')},
    'errors': {name: name for name in ('DataError', 'HandeyeError', 'InputError')},
    'pipeline': {name: name for name in ('calibrate', 'gather', 'solve')},
    'results.calibration_file': {
        name: name for name in ('read_calibration', 'write_calibration')},
    'bags.bag': {'read_bag': 'read'},
}


def __getattr__(name: str) -> Any:
    if name == '__version__':  # it stands in package.xml, and comes here by the installation
        return _version()
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f'{__name__}.{home}'), names[name])
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


@cache
def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version
    try:
        return version(__name__)
    except PackageNotFoundError:
        return 'unknown'
