"""truth.yaml: what is true of a simulated recording, kept beside it."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, TYPE_CHECKING

from handeye_ros import __version__
from handeye_ros.config import yaml_content
from handeye_ros.data import Array
from handeye_ros.results.calibration_file import transform_from, transform_values
from handeye_ros.results.errors import CalibrationFileError
import yaml

if TYPE_CHECKING:
    from handeye_ros.simulate import Measured, Simulated
    from handeye_ros.simulate.measuring import MeasuringCell

NAME = 'truth.yaml'


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


def text(values: Mapping[str, Any]) -> str:
    """Return the text of truth.yaml."""
    return str(yaml.safe_dump(dict(values), sort_keys=False, default_flow_style=None))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return list(value) if isinstance(value, tuple) else value


def true_transform(bag: Path) -> Array | None:
    """
    Return T_flange_sensor (4, 4) that is true of a bag, or None where it is not known.

    bag: a rosbag2 folder, or a file in one. Raises CalibrationFileError for a damaged truth.yaml.

    """
    path = (bag if bag.is_dir() else bag.parent) / NAME
    if not path.is_file():
        return None
    try:
        content = yaml_content(path.read_text(encoding='utf-8'))
        values = content['T_flange_sensor']
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError) as error:
        raise CalibrationFileError(path, 'it holds no T_flange_sensor') from error
    return transform_from(path, 'T_flange_sensor', values)
