"""The arrows of the layout point one way, and only handeye_ros/ros/ knows ROS."""
from __future__ import annotations

import ast
from collections.abc import Iterator, Sequence
import dataclasses
from pathlib import Path
import re
import subprocess
import sys

from handeye_ros.estimation.model import Method
import pytest

pytestmark = pytest.mark.once

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / 'handeye_ros'
FILES = sorted(PACKAGE.rglob('*.py'))
INNER = [file for file in FILES if file != PACKAGE / '__init__.py']

# The rooms, from the ground up; an arrow points down, or sideways where it is listed.
FLOORS = (
    ('data', 'config', 'errors', 'formats', 'frames', 'least_squares', 'orientations', 'output',
     'se3', 'streams', 'tables', 'units'),
    ('profiles', 'estimation', 'published', 'simulate'),
    ('checks',),
    ('targets', 'results'),
    ('sampling', 'files', 'scanning', 'verification', 'guidance'),
    ('diagnosis',),
    ('pipeline',),
    ('comparison', 'kinematics', 'batch'),
    ('cli', 'ros'),
    ('__main__',),
)
SIDEWAYS = {('verification', 'sampling'), ('verification', 'scanning'), ('cli', 'ros')}
HEIGHTS = {room: height for height, rooms in enumerate(FLOORS) for room in rooms}
ROOT_MODULES = {'__init__', '__main__', 'data', 'errors', 'frames', 'orientations', 'output',
                'pipeline', 'se3', 'tables', 'units'}
LONGEST_FUNCTION = 40  # lines
LONGEST_MODULE = 260

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


def room(name: str) -> str:
    return name.split('/')[0]


def allowed(source: str, target: str) -> bool:
    """Return whether a module of one room may import one of another."""
    ground = source in FLOORS[0] and target in FLOORS[0]
    return source == target or ground or (source, target) in SIDEWAYS or (
        HEIGHTS[source] > HEIGHTS[target])


def knows_ros(name: str) -> bool:
    first = name.split('.')[0]
    return first in ROS_NAMES or first.endswith(ROS_ENDINGS)


@pytest.mark.parametrize('file', INNER, ids=module)
def test_arrows_between_rooms_point_down(file: Path) -> None:
    source = room(module(file))
    assert not {name for name in own_imports(file) if not allowed(source, room(name))}


def test_the_root_holds_only_the_way_and_the_ground() -> None:
    assert {file.stem for file in PACKAGE.glob('*.py')} == ROOT_MODULES


def test_the_rooms_are_those_of_the_layout() -> None:
    folders = {file.parent.name for file in PACKAGE.glob('*/__init__.py')}
    assert folders <= HEIGHTS.keys()


@pytest.mark.parametrize('file', FILES, ids=module)
def test_the_first_line_says_what_a_module_holds(file: Path) -> None:
    text = ast.get_docstring(ast.parse(file.read_text(encoding='utf-8')))
    assert module(file) == '__main__' or text and text.splitlines()[0].endswith(('.', ':'))


@pytest.mark.parametrize('file', FILES, ids=module)
def test_nothing_private_is_imported_from_another_file(file: Path) -> None:
    own = [name for name in imports(file) if name.startswith(f'{PACKAGE.name}.')]
    assert not [name for name in own if name.rsplit('.', 1)[1].startswith('_')
                and not name.endswith('__')]


@pytest.mark.parametrize('file', FILES, ids=module)
def test_functions_and_modules_stay_short(file: Path) -> None:
    source = file.read_text(encoding='utf-8')
    long = {node.name for node in ast.walk(ast.parse(source))
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
            and node.end_lineno - node.lineno + 1 > LONGEST_FUNCTION}
    assert not long
    assert len(source.splitlines()) <= LONGEST_MODULE


def test_no_modules_import_each_other() -> None:
    left = {module(file): own_imports(file) - {module(file)} for file in FILES}
    while free := [name for name, needs in left.items() if not needs & left.keys()]:
        for name in free:
            del left[name]
    assert not left, 'these are in a cycle of imports, or need one that is'


@pytest.mark.parametrize(
    'file', [f for f in FILES if room(module(f)) != 'ros'], ids=module)
def test_only_the_ros_folder_imports_ros(file: Path) -> None:
    assert not [name for name in imports(file) if knows_ros(name)]


def door_of(parts: Sequence[str]) -> str:
    """Return the innermost room, of rooms in rooms too, that a dotted name lies in."""
    deepest = ''
    for depth in range(1, len(parts) + 1):
        if not PACKAGE.joinpath(*parts[:depth], '__init__.py').exists():
            break
        deepest = '/'.join(parts[:depth])
    return deepest


def names_imported_from_rooms() -> dict[str, set[str]]:
    """Return what others import from each room, by dotted names in it."""
    found: dict[str, set[str]] = {}
    for file in FILES:
        own = door_of(file.relative_to(PACKAGE).parts[:-1])
        for name in imports(file):
            package, *parts = name.split('.')
            inner = door_of(parts) if package == PACKAGE.name else ''
            if inner and inner != own and inner.count('/') + 1 < len(parts):
                found.setdefault(inner, set()).add('.'.join(parts[inner.count('/') + 1:]))
    return found


def stated(room_name: str, variable: str) -> set[str]:
    """Return a tuple or list of names that the __init__.py of a room states."""
    tree = ast.parse((PACKAGE / room_name / '__init__.py').read_text(encoding='utf-8'))
    values = [ast.literal_eval(node.value) for node in tree.body if isinstance(node, ast.Assign)
              and [ast.unparse(target) for target in node.targets] == [variable]]
    return set().union(*values)


def test_rooms_offer_what_others_import_of_them_and_nothing_else() -> None:
    imported = names_imported_from_rooms()
    rooms = {file.parent.relative_to(PACKAGE).as_posix() for file in INNER
             if file.name == '__init__.py'}
    missing = {name: lacking for name in rooms if (lacking := sorted(
        imported.get(name, set()) - stated(name, 'OFFERED') - stated(name, '__all__')))}
    unused = {name: rest for name in rooms if (rest := sorted(
        stated(name, 'OFFERED') - imported.get(name, set())))}
    assert not missing, f'add to OFFERED in the __init__.py: {missing}'
    assert not unused, f'remove from OFFERED in the __init__.py: {unused}'


def test_the_simulator_knows_nothing_of_the_estimator() -> None:
    files = [f for f in FILES if room(module(f)) == 'simulate']
    assert files
    for file in files:
        others = {room(name) for name in own_imports(file)} - {'simulate'}
        assert others <= set(FLOORS[0])


def test_the_checks_see_what_they_forbid() -> None:
    source = 'def f():\n    from rclpy.node import Node\nimport std_srvs.srv\nimport numpy\n'
    assert [n for n in modules_imported(source) if knows_ros(n)] == [
        'std_srvs.srv', 'rclpy.node.Node']
    assert allowed('ros', 'pipeline') and allowed('targets', 'estimation')
    assert not allowed('estimation', 'targets') and not allowed('profiles', 'estimation')


def run_without_ros(code: str) -> subprocess.CompletedProcess[str]:
    """Run code in a Python to which rclpy is not installed."""
    block = "import sys; sys.modules['rclpy'] = None; "
    return subprocess.run(
        [sys.executable, '-c', block + code], cwd=ROOT, capture_output=True, text=True,
        check=False)


def test_the_command_line_starts_without_ros() -> None:
    run = run_without_ros('from handeye_ros.cli import command; command()')
    assert run.returncode == 0, run.stderr


def test_solve_needs_no_ros(tmp_path: Path) -> None:
    arguments = ['handeye', 'solve', 'bags/plate', '--config', 'config/plate.yaml',
                 '--out', str(tmp_path)]
    run = run_without_ros(
        f'sys.argv = {arguments}; from handeye_ros.cli import main; main()')
    assert run.returncode == 0, run.stderr
    assert (tmp_path / 'calibration.yaml').exists()


def test_the_estimation_names_no_target() -> None:
    words = re.compile(r'\b\w*(edge|face|plate|sphere|ball|corner|bevel)s?(?=\b|_)', re.IGNORECASE)
    for file in sorted((PACKAGE / 'estimation').glob('*.py')):
        text = file.read_text(encoding='utf-8').replace('surface', '')
        found = {match[0] for match in words.finditer(text)}
        assert not found, f'{file.name} names what is of one target: {found}'
    assert len(dataclasses.fields(Method)) <= 10
