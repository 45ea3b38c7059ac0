# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Targets that are solved from files of measured values, here called tables.

Beside that of a tracker there is a bag, of the sweep.
"""
from __future__ import annotations

from pathlib import Path

from handeye_ros.config import Config
from handeye_ros.errors import BadValueError, InputError
from handeye_ros.tabulated.pairs import PointPairs, PosePairs
from handeye_ros.tabulated.problem import TableProblem
from handeye_ros.tabulated.tracker import TrackerProblem

FILE_TARGETS: dict[str, type[TableProblem]] = {
    problem.name: problem for problem in (PointPairs, PosePairs, TrackerProblem)}


def read_table(path: Path, config: Config) -> TableProblem:
    """
    Return what a file holds of the configuration's target.

    Raises BadValueError for a method or a calibration type that the target does not have, and
    InputError, DataError.
    """
    name = config.target.type
    if name not in FILE_TARGETS:
        fitting = PointPairs.name, PosePairs.name  # a tracker's file is the bag
        raise InputError(f'{path} is a table of measured values, and target.type {name} is not '
                         f'solved from one: set target.type to {" or ".join(fitting)}, as in '
                         f'--set target.type={fitting[0]}')
    for key, value, choices in (('method', config.method, ('auto', name)),
                                ('calibration_type', config.calibration_type,
                                 FILE_TARGETS[name].calibration_types)):
        if value not in choices:
            raise BadValueError(key, value, f'{" or ".join(choices)} with target.type {name}')
    return FILE_TARGETS[name].read(path, config)
