# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Scenes of targets that are solved from files, and how they are given to the command."""
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from command import ROOT
from handeye_ros.tabulated import FILE_METHODS

TABLES = {'points': 'points.csv', 'hand_eye': 'poses.csv', 'tracker': 'tracker.csv'}
Run = Callable[..., tuple[int, str, str]]


def target_of(name: str) -> str:
    return next(target for target in FILE_METHODS if target in name)


def given(name: str, folder: Path) -> tuple[object, ...]:
    """Return the arguments that solve or compare what is in the folder of a scene."""
    target = target_of(name)
    where = 'eye_on_base' if name in ('points', 'hand_eye_on_base') else 'eye_in_hand'
    return (folder if target == 'tracker' else folder / TABLES[target], '--config',
            ROOT / 'config' / f'{target}.yaml', '--set', f'calibration_type={where}')
