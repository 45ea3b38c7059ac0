"""Simulated recordings and files of measured values, each with its truth, as folders."""
from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from handeye_ros import __version__
from handeye_ros.data import Array
from handeye_ros.results import folder, truth_file
from handeye_ros.results.calibration_file import transform_values
from handeye_ros.ros.bags import bag_write
from handeye_ros.scanning.cloud_files import cloud_writer
from handeye_ros.simulate import (
    arm,
    FAULTS,
    FILE_SCENES,
    Measured,
    SCENARIOS,
    simulate,
    Simulated,
)
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
        bag_write.write(path, made.profiles, made.poses, truth=truth_values(made, seed),
                        tables={'robot.urdf': arm.urdf()} if joints else {}, force=force,
                        joints=joints)
        return f'{len(made.profiles)} profiles, {len(made.poses)} poses'
    measured = FILE_SCENES[name](rng)
    values = measured_truth_values(measured, name, seed)
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
    truth = cell_truth_values(cell, MEASURING_CELL, seed)

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


def truth_values(simulated: Simulated, seed: int) -> dict[str, Any]:
    """Return what truth.yaml holds, with all that is needed to make the recording again."""
    scenario, offset = simulated.scenario, simulated.truth.time_offset
    return {
        **_values(scenario.name, seed, simulated.truth.T_flange_sensor),
        'T_base_target': transform_values(simulated.truth.T_base_target),
        **({} if offset is None else {'time_offset': offset}),
        'noise': {'sensor': scenario.sensor.noise,
                  'robot_translation': scenario.robot.repeatability[0],
                  'robot_rotation': scenario.robot.repeatability[1]},
        'parameters': _plain(asdict(scenario)),
    }


def measured_truth_values(made: Measured, name: str, seed: int) -> dict[str, Any]:
    """Return what truth.yaml holds beside files of measured values; name: of the scene."""
    return {**_values(name, seed, made.T_flange_sensor), 'noise': _plain(dict(made.noise)),
            'settings': _plain(dict(made.settings))}


def cell_truth_values(cell: MeasuringCell, name: str, seed: int) -> dict[str, Any]:
    """Return what truth.yaml holds beside the recordings of a cell that measures."""
    return {**_values(name, seed, cell.T_flange_sensor),
            'artefacts': {'ball_radius': cell.ball_radius, 'bar': cell.bar,
                          'gauge': _plain(asdict(cell.gauge))}}


def _values(name: str, seed: int, T_flange_sensor: Array) -> dict[str, Any]:
    return {'made_by': f'handeye_ros {__version__}: handeye simulate {name} --seed {seed}',
            'scenario': name, 'seed': seed,
            'T_flange_sensor': transform_values(T_flange_sensor)}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return list(value) if isinstance(value, tuple) else value
