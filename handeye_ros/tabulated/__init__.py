# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Targets that are solved from files of measured values."""
from __future__ import annotations

from pathlib import Path

from handeye_ros.config import Config
from handeye_ros.errors import BadValueError, InputError
from handeye_ros.tabulated.pairs import PointPairs, PosePairs
from handeye_ros.tabulated.problem import TableProblem
from handeye_ros.tabulated.tracker import TrackerProblem

FILE_TARGETS: dict[str, type[TableProblem]] = {
    problem.name: problem for problem in (PointPairs, PosePairs, TrackerProblem)}


def is_solved_from_files(config: Config) -> bool:
    """
    Return whether a configuration is of a target that is solved from files.

    Raises BadValueError for a method or a calibration type that it cannot be of.
    """
    name = config.target.type
    if name not in FILE_TARGETS:
        return False
    for key, value, fitting in (('method', config.method, ('auto', name)),
                                ('calibration_type', config.calibration_type,
                                 FILE_TARGETS[name].calibration_types)):
        if value not in fitting:
            raise BadValueError(key, value, f'{" or ".join(fitting)} with target.type {name}')
    return True


def read(path: Path, config: Config) -> TableProblem:
    """Return what a file holds of the configuration's target; raises InputError, DataError."""
    if not is_solved_from_files(config):
        fitting = list(FILE_TARGETS)
        raise InputError(f'{path} is a table of measured values, and target.type '
                         f'{config.target.type} is not solved from one: set '
                         f'target.type to {" or ".join(fitting)}, as in --set '
                         f'target.type={fitting[0]}')
    return FILE_TARGETS[config.target.type].read(path, config)
