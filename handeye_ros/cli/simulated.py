"""Simulated recordings and files of measured values, each with its truth, as folders."""
from __future__ import annotations

from pathlib import Path

from handeye_ros.results import folder, truth_file
from handeye_ros.ros.bags import bag_write
from handeye_ros.scanning.cloud_files import cloud_writer
from handeye_ros.simulate import arm, FAULTS, FILE_SCENES, SCENARIOS, simulate
from handeye_ros.simulate.measuring import MEASURING_CELL, measuring_cell, MeasuringCell
from handeye_ros.simulate.preform import Preform, preform_cloud
import numpy as np


def write(name: str, seed: int, path: Path, force: bool = False) -> str:
    """
    Write the folder of a scenario or a scene of files; return what is in it, in words.

    force: what is there is replaced. Raises BagError, UnwritableError.
    """
    rng = np.random.default_rng(seed)
    if name == MEASURING_CELL:
        return _write_cell(measuring_cell(rng), seed, path, force)
    scenario = SCENARIOS.get(name) or FAULTS.get(name)
    if scenario:
        made = simulate(scenario, rng)
        joints = made.joints()
        bag_write.write(path, made.profiles, made.poses, truth=truth_file.truth_values(made, seed),
                        tables={'robot.urdf': arm.urdf()} if joints else {}, force=force,
                        joints=joints)
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


def _write_cell(cell: MeasuringCell, seed: int, path: Path, force: bool) -> str:
    """Write a folder of recordings, and the cloud of a preform with a seam."""
    truth = truth_file.cell_truth_values(cell, MEASURING_CELL, seed)

    def fill(made: Path) -> None:
        made.mkdir()
        for name, recording in cell.recordings.items():
            bag_write.write(made / name, recording.profiles, recording.poses, truth=truth)
        preform = preform_cloud(Preform(), np.random.default_rng(seed))
        rows = np.empty(len(preform.points), [(axis, '<f4') for axis in 'xyz'])
        for k, axis in enumerate('xyz'):
            rows[axis] = preform.points[:, k]
        with cloud_writer(made / 'preform.ply', 'frame base, metres') as writer:
            writer.write(rows)

    folder.write(path, {truth_file.NAME: truth_file.text(truth)}, fill, force)
    return f'{", ".join(cell.recordings)}, preform.ply'
