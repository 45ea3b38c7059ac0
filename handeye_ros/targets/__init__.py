# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The target models, one file each."""
from __future__ import annotations

from collections.abc import Sequence

from handeye_ros.config import Config, SOLVED_FROM_FILES
from handeye_ros.data import Sample
from handeye_ros.errors import BadValueError, InputError
from handeye_ros.estimation.problem import Problem
from handeye_ros.frames import mount_poses_of
from handeye_ros.targets.line import LINE
from handeye_ros.targets.plane import PLANE
from handeye_ros.targets.plate import PLATE
from handeye_ros.targets.profile_target import ProfileTarget
from handeye_ros.targets.sphere import SPHERE
from handeye_ros.targets.wedge import WEDGE

TARGETS: dict[str, ProfileTarget] = {
    target.name: target for target in (PLATE, LINE, PLANE, SPHERE, WEDGE)}


def target_for(config: Config) -> ProfileTarget:
    """
    Return the target that a configuration asks for.

    Raises InputError for a name that does not exist, or a target that is solved from files.
    """
    if config.target.type in SOLVED_FROM_FILES:
        raise InputError(f'target.type {config.target.type} is solved from files ("handeye solve '
                         'INPUT --config FILE"), and profiles show no such target')
    key, name = ('target.type', config.target.type) if config.method == 'auto' else (
        'method', config.method)
    if name not in TARGETS:
        known = [*TARGETS, *SOLVED_FROM_FILES] if key == 'target.type' else TARGETS
        raise BadValueError(key, name, 'one of ' + ', '.join(known))
    return TARGETS[name]


def problem_of_known_poses(samples: Sequence[Sample], config: Config) -> Problem:
    """Return the problem of samples whose poses are known, as those of stops are."""
    target = target_for(config)
    return Problem(target, mount_poses_of(samples, config), target.observe(samples), config)
