"""Simulated recordings and files of measured values, each with its truth, as folders."""
from __future__ import annotations

from pathlib import Path

from handeye_ros.results import folder, truth_file
from handeye_ros.ros.bags import bag_write
from handeye_ros.simulate import FAULTS, FILE_SCENES, SCENARIOS, simulate
import numpy as np


def write(name: str, seed: int, path: Path, force: bool = False) -> str:
    """
    Write the folder of a scenario or a scene of files; return what is in it, in words.

    force: what is there is replaced. Raises BagError, UnwritableError.
    """
    rng = np.random.default_rng(seed)
    scenario = SCENARIOS.get(name) or FAULTS.get(name)
    if scenario:
        made = simulate(scenario, rng)
        bag_write.write(path, made.profiles, made.poses, truth=truth_file.truth_values(made, seed),
                        force=force)
        return f'{len(made.profiles)} profiles, {len(made.poses)} poses'
    measured = FILE_SCENES[name](rng)
    values = truth_file.measured_truth_values(measured, name, seed)
    names = ', '.join(measured.tables)
    if not measured.profiles:
        folder.write(path, {**measured.tables, truth_file.NAME: truth_file.text(values)},
                     force=force)
        return names
    bag_write.write(path, measured.profiles, measured.poses, tables=measured.tables,
                    truth=values, force=force)
    return f'{len(measured.profiles)} profiles, {len(measured.poses)} poses, {names}'
