# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Simulated recordings and files of measured values, each with its truth, as folders."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
import json
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
)
import numpy as np
from numpy.lib.recfunctions import unstructured_to_structured


def write(name: str, seed: int, path: Path, force: bool = False) -> str:
    """
    Write the folder of a scenario or a scene of files; return its content in words.

    force: replace an existing folder. Raises InputError, UnwritableError.
    """
    rng = np.random.default_rng(seed)

    def truth(T_flange_sensor: Array, **more: Any) -> dict[str, Any]:
        values = {'made_by': f'handeye_ros {__version__}: handeye simulate {name} --seed {seed}',
                  'scenario': name, 'seed': seed,
                  'T_flange_sensor': transform_values(T_flange_sensor), **more}
        return dict(json.loads(json.dumps(values)))  # lists where there are tuples

    if name == measuring.MEASURING_CELL:
        return _write_cell(measuring.measuring_cell(rng), truth, seed, path, force)
    scenario = SCENARIOS.get(name) or FAULTS.get(name)
    tables: Mapping[str, str]
    if scenario:
        made = simulate(scenario, rng)
        found, joints = made.truth, made.joints()
        tables = {'robot.urdf': robot.urdf()} if joints else {}
        values = truth(
            found.T_flange_sensor, T_base_target=transform_values(found.T_base_target),
            **({} if found.time_offset is None else {'time_offset': found.time_offset}),
            noise={'sensor': scenario.sensor.noise,
                   'robot_translation': scenario.robot.repeatability[0],
                   'robot_rotation': scenario.robot.repeatability[1]},
            parameters=asdict(scenario))
        bag_write.write(path, made.profiles, made.poses, truth=values, tables=tables, force=force,
                        joints=joints)
        return f'{len(made.profiles)} profiles, {len(made.poses)} poses'
    measured = FILE_SCENES[name](rng)
    values = truth(measured.T_flange_sensor, noise=dict(measured.noise),
                   settings=dict(measured.settings))
    names = ', '.join(measured.tables)
    if not measured.profiles:
        bag_write.write_folder(
            path, {**measured.tables, truth_file.NAME: truth_file.text(values)}, force=force)
        return names
    bag_write.write(path, measured.profiles, measured.poses, tables=measured.tables, truth=values,
                    force=force)
    return f'{len(measured.profiles)} profiles, {len(measured.poses)} poses, {names}'


def _write_cell(cell: measuring.MeasuringCell, truth: Callable[..., dict[str, Any]], seed: int,
                path: Path, force: bool) -> str:
    """Write a folder of recordings, and the cloud of a preform with a seam."""
    values = truth(cell.T_flange_sensor, artefacts={
        'ball_radius': cell.ball_radius, 'bar': cell.bar, 'gauge': asdict(cell.gauge)})

    def fill(folder: Path) -> None:
        folder.mkdir()
        for name, recording in cell.recordings.items():
            bag_write.write(folder / name, recording.profiles, recording.poses, truth=values)
        points = measuring.preform_cloud(measuring.Preform(), np.random.default_rng(seed)).points
        rows = unstructured_to_structured(points, np.dtype([(axis, '<f4') for axis in 'xyz']))
        with cloud_writer(folder / 'preform.ply', 'frame base, metres') as writer:
            writer.write(rows)

    bag_write.write_folder(path, {truth_file.NAME: truth_file.text(values)}, fill, force)
    return f'{", ".join(cell.recordings)}, preform.ply'
