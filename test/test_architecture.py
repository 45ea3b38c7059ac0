"""The arrows of the layout point one way, and only handeye_ros/ros/ knows ROS."""
from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / 'handeye_ros'
FILES = sorted(PACKAGE.rglob('*.py'))

# cli, ros -> pipeline -> every other module, a stage -> se3, config, data, errors;
# the comparison runs the pipeline and stands beside it
HEIGHTS = {'errors': 0, 'data': 0, 'config': 0, 'se3': 0, 'pipeline': 2,
           'estimators': 2, 'compare': 2, 'report_compare': 2, 'cli': 3, 'ros': 3, '__main__': 4}
STAGE = 1

ROS_NAMES = {'ament_index_python', 'builtin_interfaces', 'launch', 'launch_ros', 'mcap',
             'rclpy', 'rosbag2_py', 'rosbags', 'tf2_ros'}
ROS_ENDINGS = ('_msgs', '_srvs', '_interfaces')


def modules_imported(source: str) -> Iterator[str]:
    """Yield the dotted name of everything that the source imports, wherever it does."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, 'imports are absolute here'
            yield from (f'{node.module}.{alias.name}' for alias in node.names)


def imports(file: Path) -> list[str]:
    return list(modules_imported(file.read_text(encoding='utf-8')))


def own_imports(file: Path) -> set[str]:
    """Return the modules of this package that the file imports, as paths below the package."""
    found = set()
    for name in imports(file):
        first, *parts = name.split('.')
        if first == PACKAGE.name:
            found.add(longest_module(parts))
    return found - {''}


def longest_module(parts: list[str]) -> str:
    while parts:
        path = PACKAGE.joinpath(*parts)
        if path.with_suffix('.py').exists() or (path / '__init__.py').exists():
            return '/'.join(parts)
        parts = parts[:-1]
    return ''


def module(file: Path) -> str:
    relative = file.relative_to(PACKAGE).with_suffix('')
    return str(relative.parent if relative.name == '__init__' else relative)


def height(name: str) -> int:
    return HEIGHTS.get(name.split('/')[0], STAGE)


def knows_ros(name: str) -> bool:
    first = name.split('.')[0]
    return first in ROS_NAMES or first.endswith(ROS_ENDINGS)


@pytest.mark.parametrize('file', FILES, ids=module)
def test_no_module_imports_one_above_it(file: Path) -> None:
    above = {name for name in own_imports(file) if height(name) > height(module(file))}
    assert not above


def test_no_modules_import_each_other() -> None:
    left = {module(file): own_imports(file) - {module(file)} for file in FILES}
    while free := [name for name, needs in left.items() if not needs & left.keys()]:
        for name in free:
            del left[name]
    assert not left, 'these are in a cycle of imports, or need one that is'


@pytest.mark.parametrize(
    'file', [f for f in FILES if module(f).split('/')[0] != 'ros'], ids=module)
def test_only_the_ros_folder_imports_ros(file: Path) -> None:
    assert not [name for name in imports(file) if knows_ros(name)]


def test_the_simulator_knows_nothing_of_the_estimator() -> None:
    files = [f for f in FILES if module(f).split('/')[0] == 'simulate']
    assert files
    for file in files:
        others = {n for n in own_imports(file) if n.split('/')[0] != 'simulate'}
        assert {n for n in others if height(n) > 0} == set()


def test_the_checks_see_what_they_forbid() -> None:
    source = 'def f():\n    from rclpy.node import Node\nimport std_srvs.srv\nimport numpy\n'
    assert [n for n in modules_imported(source) if knows_ros(n)] == [
        'std_srvs.srv', 'rclpy.node.Node']
    assert height('ros/bag') > height('pipeline') > height('methods/plate') > height('se3')


def run_without_ros(code: str) -> subprocess.CompletedProcess[str]:
    """Run code in a Python to which rclpy is not installed."""
    block = "import sys; sys.modules['rclpy'] = None; "
    return subprocess.run(
        [sys.executable, '-c', block + code], cwd=ROOT, capture_output=True, text=True,
        check=False)


def test_the_command_line_starts_without_ros() -> None:
    run = run_without_ros('import handeye_ros.cli')
    assert run.returncode == 0, run.stderr


def test_solve_needs_no_ros(tmp_path: Path) -> None:
    arguments = ['handeye', 'solve', 'bags/plate', '--config', 'config/plate.yaml',
                 '--out', str(tmp_path)]
    run = run_without_ros(
        f'sys.argv = {arguments}; from handeye_ros.cli import main; main()')
    assert run.returncode == 0, run.stderr
    assert (tmp_path / 'calibration.yaml').exists()
