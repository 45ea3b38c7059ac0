# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Simulated recordings and files of measured values, each with its truth, as folders."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from handeye_ros import __version__, se3
from handeye_ros.bags import bag_write
from handeye_ros.data import Array
from handeye_ros.output import yaml_text
from handeye_ros.results.calibration_file import TRUTH_NAME
from handeye_ros.scanning.cloud import write_cloud
from handeye_ros.simulate import (
    FAULTS,
    FILE_SCENES,
    measuring,
    robot,
    SCENARIOS,
    simulate,
    Simulated,
    SimulatedFiles,
)
import numpy as np
from numpy.lib.recfunctions import unstructured_to_structured

PREFORM_FILE = 'preform.ply'


def write(name: str, seed: int, path: Path, force: bool = False) -> str:
    """
    Write the folder of a scenario or a scene of files; return its content in words.

    force: replace an existing folder. Raises InputError, UnwritableError.
    """
    rng = np.random.default_rng(seed)

    def truth(T_flange_sensor: Array, **more: Any) -> dict[str, Any]:
        return {'made_by': f'handeye_ros {__version__}: handeye simulate {name} --seed {seed}',
                'scenario': name, 'seed': seed,
                'T_flange_sensor': se3.transform_values(T_flange_sensor), **more}

    if name == measuring.MEASURING_CELL:
        recordings, X = measuring.measuring_cell(rng)
        _write_cell(path, recordings, truth(X, artefacts={
            'ball_radius': measuring.GAUGE_BALL.radius, 'bar': measuring.BALL_BAR_LENGTH,
            'gauge': asdict(measuring.Gauge())}), seed, force)
        return f'{", ".join(recordings)}, {PREFORM_FILE}'
    joints: Sequence[tuple[int, Array]] = ()
    made: Simulated | SimulatedFiles
    if scenario := SCENARIOS.get(name) or FAULTS.get(name):
        made = simulate(scenario, rng)
        known, joints = made.truth, made.joints()
        tables: Mapping[str, str] = {'robot.urdf': robot.urdf()} if joints else {}
        values = truth(
            known.T_flange_sensor, T_base_target=se3.transform_values(known.T_base_target),
            **({} if known.time_offset is None else {'time_offset': known.time_offset}),
            **({} if known.T_corrected_sensor is None else {
                'T_corrected_sensor': se3.transform_values(known.T_corrected_sensor)}),
            noise={'sensor': scenario.sensor.noise,
                   'robot_translation': scenario.robot.repeatability[0],
                   'robot_rotation': scenario.robot.repeatability[1]},
            parameters=asdict(scenario))
    else:
        made = FILE_SCENES[name](rng)
        tables = made.tables
        values = truth(made.T_flange_sensor, noise=made.noise, settings=made.settings)
    if not made.profiles:
        bag_write.write_folder(path, {**tables, TRUTH_NAME: yaml_text(values)},
                               force=force)
        return ', '.join(tables)
    bag_write.write(path, made.profiles, made.poses, truth=values, tables=tables, force=force,
                    joints=joints)
    return ', '.join([f'{len(made.profiles)} profiles', f'{len(made.poses)} poses', *tables])


def _write_cell(path: Path, recordings: Mapping[str, measuring.Messages],
                truth: Mapping[str, Any], seed: int, force: bool) -> None:
    """Write a folder of recordings, and the cloud of a preform with a seam."""
    def fill(folder: Path) -> None:
        folder.mkdir()
        for name, recording in recordings.items():
            bag_write.write(folder / name, recording.profiles, recording.poses, truth=truth)
        points = measuring.preform_cloud(measuring.Preform(), np.random.default_rng(seed)).points
        rows = unstructured_to_structured(points, np.dtype([(axis, '<f4') for axis in 'xyz']))
        write_cloud(folder / PREFORM_FILE, [rows], 'frame base, metres')

    bag_write.write_folder(path, {TRUTH_NAME: yaml_text(truth)}, fill, force)
