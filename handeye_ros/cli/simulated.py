# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Writes what is simulated: bags, tables and a cloud, with the truth."""
from __future__ import annotations

from pathlib import Path

from handeye_ros import __version__
from handeye_ros.bags import writer
from handeye_ros.output import yaml_text
from handeye_ros.results.truth import TRUTH_NAME
from handeye_ros.scanning.cloud import write_cloud
from handeye_ros.simulate.artefacts import MEASURING_CELL, measuring_cell, preform_cloud
from handeye_ros.simulate.recording import simulate, Simulated
from handeye_ros.simulate.scenario import FAULTS, SCENARIOS
from handeye_ros.simulate.tables import FILE_SCENES
import numpy as np
from numpy.lib.recfunctions import unstructured_to_structured

PREFORM_FILE = 'preform.ply'
CELLS = {**SCENARIOS, **FAULTS}
NAMES = [*CELLS, *FILE_SCENES, MEASURING_CELL]  # of all that can be simulated


def write_simulated(name: str, seed: int, folder: Path, force: bool = False) -> str:
    """
    Write the folder of a scenario, of a scene of files or of MEASURING_CELL.

    Returns its content in words. force: whether an existing folder is replaced; without it
    InputError is raised. Raises UnwritableError where the folder cannot be written.
    """
    rng = np.random.default_rng(seed)
    origin = {'made_by': f'handeye_ros {__version__}: handeye simulate {name} --seed {seed}',
              'scenario': name, 'seed': seed}
    if name == MEASURING_CELL:
        recordings, true_values = measuring_cell(rng)
        texts = {TRUTH_NAME: yaml_text({**origin, **true_values})}

        def write_recordings(new_folder: Path) -> None:
            new_folder.mkdir()
            for part, messages in recordings.items():
                writer.write(new_folder / part, messages.profiles, messages.poses, texts=texts)
            cloud = preform_cloud(np.random.default_rng(seed))
            rows = unstructured_to_structured(cloud.points,
                                              np.dtype([(axis, '<f4') for axis in 'xyz']))
            write_cloud(new_folder / PREFORM_FILE, [rows], 'frame base, metres')

        writer.write_folder(folder, texts, write_recordings, force)
        return ', '.join([*recordings, PREFORM_FILE])
    simulated = simulate(CELLS[name], rng) if name in CELLS else FILE_SCENES[name](rng)
    texts = {**simulated.tables, TRUTH_NAME: yaml_text({**origin, **simulated.true_values})}
    if not simulated.profiles:
        writer.write_folder(folder, texts, force=force)
        return ', '.join(simulated.tables)
    writer.write(folder, simulated.profiles, simulated.poses, texts=texts, force=force,
                 joints=simulated.joints if isinstance(simulated, Simulated) else ())
    return ', '.join([f'{len(simulated.profiles)} profiles', f'{len(simulated.poses)} poses',
                      *simulated.tables])
