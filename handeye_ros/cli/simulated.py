# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Simulated recordings and files of measured values, each with its truth, as folders."""
from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from handeye_ros import __version__
from handeye_ros.bags import bag_write
from handeye_ros.data import Array
from handeye_ros.results import truth_file
from handeye_ros.results.calibration_file import transform_values
from handeye_ros.scanning.cloud import cloud_writer
from handeye_ros.simulate import (
    FAULTS,
    FILE_SCENES,
    measuring,
    robot,
    SCENARIOS,
    simulate,
    Simulated,
)
import numpy as np


def write(name: str, seed: int, path: Path, force: bool = False) -> str:
    """
    Write the folder of a scenario or a scene of files; return its content in words.

    force: replace an existing folder. Raises BagError, UnwritableError.
    """
    rng = np.random.default_rng(seed)
    if name == measuring.MEASURING_CELL:
        return _write_cell(measuring.measuring_cell(rng), seed, path, force)
    scenario = SCENARIOS.get(name) or FAULTS.get(name)
    if scenario:
        recording = simulate(scenario, rng)
        joints = recording.joints()
        bag_write.write(path, recording.profiles, recording.poses,
                        truth=truth_values(recording, seed),
                        tables={'robot.urdf': robot.urdf()} if joints else {}, force=force,
                        joints=joints)
        return f'{len(recording.profiles)} profiles, {len(recording.poses)} poses'
    measured = FILE_SCENES[name](rng)
    values = {**_values(name, seed, measured.T_flange_sensor),
              'noise': _plain(dict(measured.noise)), 'settings': _plain(dict(measured.settings))}
    names = ', '.join(measured.tables)
    if not measured.profiles:
        bag_write.write_folder(
            path, {**measured.tables, truth_file.NAME: truth_file.text(values)}, force=force)
        return names
    bag_write.write(path, measured.profiles, measured.poses, tables=measured.tables,
                    truth=values, force=force)
    return f'{len(measured.profiles)} profiles, {len(measured.poses)} poses, {names}'


def _write_cell(cell: measuring.MeasuringCell, seed: int, path: Path, force: bool) -> str:
    """Write a folder of recordings, and the cloud of a preform with a seam."""
    truth = {**_values(measuring.MEASURING_CELL, seed, cell.T_flange_sensor),
             'artefacts': {'ball_radius': cell.ball_radius, 'bar': cell.bar,
                           'gauge': _plain(asdict(cell.gauge))}}

    def fill(folder: Path) -> None:
        folder.mkdir()
        for name, recording in cell.recordings.items():
            bag_write.write(folder / name, recording.profiles, recording.poses, truth=truth)
        preform = measuring.preform_cloud(measuring.Preform(), np.random.default_rng(seed))
        rows = np.empty(len(preform.points), [(axis, '<f4') for axis in 'xyz'])
        for k, axis in enumerate('xyz'):
            rows[axis] = preform.points[:, k]
        with cloud_writer(folder / 'preform.ply', 'frame base, metres') as writer:
            writer.write(rows)

    bag_write.write_folder(path, {truth_file.NAME: truth_file.text(truth)}, fill, force)
    return f'{", ".join(cell.recordings)}, preform.ply'


def truth_values(simulated: Simulated, seed: int) -> dict[str, Any]:
    """Return the content of truth.yaml, with all parameters of the recording."""
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


def _values(name: str, seed: int, T_flange_sensor: Array) -> dict[str, Any]:
    return {'made_by': f'handeye_ros {__version__}: handeye simulate {name} --seed {seed}',
            'scenario': name, 'seed': seed,
            'T_flange_sensor': transform_values(T_flange_sensor)}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return list(value) if isinstance(value, tuple) else value
