"""The launch file, evaluated by stand-ins for the classes of launch that it uses."""
from __future__ import annotations

from pathlib import Path
import sys
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]


class Substitution:
    """Looks up an argument, finds the share folder, or joins a path."""

    def __init__(self, *given: Any) -> None:
        self._given = given

    def perform(self, arguments: dict[str, str]) -> str:
        (given,) = self._given
        if isinstance(given, list):
            return '/'.join(p if isinstance(p, str) else p.perform(arguments) for p in given)
        return str(ROOT) if given == 'handeye_ros' else arguments[given]


class Described:
    """Keeps what a launch entity is made with."""

    def __init__(self, *given: Any, **options: Any) -> None:
        self.given, self.options = given, options


NAMES = {'launch': ['LaunchDescription'], 'launch.actions': ['DeclareLaunchArgument'],
         'launch.substitutions': ['LaunchConfiguration', 'PathJoinSubstitution'],
         'launch_ros': [], 'launch_ros.actions': ['Node'],
         'launch_ros.parameter_descriptions': ['ParameterValue'],
         'launch_ros.substitutions': ['FindPackageShare']}


@pytest.fixture
def described(monkeypatch: pytest.MonkeyPatch) -> tuple[dict[str, str], Described]:
    """Return the arguments with their default values, and the node."""
    for name, classes in NAMES.items():
        module = ModuleType(name)
        for each in classes:
            setattr(module, each,
                    Substitution if name.endswith('substitutions') else Described)
        monkeypatch.setitem(sys.modules, name, module)
    file = ROOT / 'launch' / 'calibrate.launch.py'
    names: dict[str, Any] = {}
    exec(compile(file.read_text(), file, 'exec'), names)
    *declared, node = names['generate_launch_description']().given[0]
    defaults = {argument.given[0]: argument.options['default_value'] for argument in declared}
    return {name: value if isinstance(value, str) else value.perform({})
            for name, value in defaults.items()}, node


def test_the_node_gets_its_file_and_the_time(described: Any) -> None:
    arguments, node = described
    assert arguments == {'params_file': str(ROOT / 'config' / 'plate.yaml'),
                         'use_sim_time': 'false'}
    assert Path(arguments['params_file']).exists()
    options = node.options
    assert (options['package'], options['executable'], options['name']) == (
        'handeye_ros', 'calibrate', 'handeye')
    time, file = options['parameters']
    value = time['use_sim_time']
    assert value.given[0].perform({'use_sim_time': 'true'}) == 'true'
    assert value.options == {'value_type': bool}
    assert file.perform({'params_file': 'mine.yaml'}) == 'mine.yaml'


def test_the_executable_is_installed() -> None:
    assert "'calibrate = handeye_ros.ros.node.node:main'" in (ROOT / 'setup.py').read_text()
