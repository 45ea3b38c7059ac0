"""Every command line of the README and the docs is run, or its names are looked up."""
from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import re
import shlex
import subprocess

from command import handeye, ROOT
from handeye_ros import config as configs
import pytest

PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted((ROOT / 'docs').glob('*.md'))]
PROGRAM = re.compile(r'^(?:\$ )?(?:[A-Z_]+=\S+ )*(?:\.venv/bin/)?'
                     r'(handeye|make|ros2|python)(?= [-\w./]+(?: |$))')
STANDS_FOR = {'path/to/bag': 'bags/plate'}
ELSEWHERE = ('handeye replay', 'handeye calibrate')  # other tests run these, and they do not end


def commands(page: Path) -> Iterator[str]:
    """Yield the commands in the code blocks of a page, without prompt and comment."""
    fenced = False
    lines = iter(page.read_text(encoding='utf-8').splitlines())
    for line in lines:
        if line.lstrip().startswith('```'):
            fenced = not fenced
        elif fenced or line.startswith('    '):
            text = line.strip().removeprefix('$ ')
            while text.endswith('\\'):
                text = text[:-1] + next(lines).strip()
            if PROGRAM.match(text):
                yield re.sub(r'\s+# (?!exit code).*', '', text).replace('.venv/bin/', '')


def words(command: str, program: str) -> list[str]:
    for placeholder, real in STANDS_FOR.items():
        command = command.replace(placeholder, real)
    found = shlex.split(command)
    return found[found.index(program) + 1:]


def of(program: str) -> list[object]:
    """Return (page, command) of all commands of a program, each once."""
    return [pytest.param(page, text, id=f'{page.stem}: {text}')
            for page in PAGES for text in dict.fromkeys(commands(page))
            if PROGRAM.match(text)[1] == program]  # type: ignore[index]


def test_there_are_commands() -> None:
    assert {'handeye', 'make', 'ros2'} <= {
        PROGRAM.match(text)[1] for page in PAGES for text in commands(page)}  # type: ignore[index]


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with what a clone holds, in which the commands run one after another."""
    made = tmp_path_factory.mktemp('clone')
    for name in ('bags', 'config'):
        (made / name).symlink_to(ROOT / name)
    assert handeye('solve', 'bags/plate', '--config', 'config/plate.yaml', '--out', '.',
                   cwd=made).returncode == 0
    for target, file in (('points', 'points.csv'), ('hand_eye', 'poses.csv')):
        assert handeye('simulate', target, target, cwd=made).returncode == 0
        (made / file).symlink_to(made / target / file)
    return made


@pytest.mark.parametrize(('page', 'command'), of('handeye'))
def test_handeye(page: Path, command: str, folder: Path) -> None:
    if command.startswith(ELSEWHERE):
        pytest.skip('other tests run it')
    command, _, code = command.partition('# exit code ')
    arguments = words(command, 'handeye')
    if any(word.startswith('../shared') for word in arguments):
        pytest.skip('a recording that is not part of the project')
    run = handeye(*arguments, cwd=folder)
    assert run.returncode == int(code or 0), run.stderr


@pytest.mark.parametrize(('page', 'command'), of('make'))
def test_make(page: Path, command: str) -> None:
    arguments = [word for word in words(command, 'make') if word.split('=')[0].isidentifier()]
    run = subprocess.run(['make', '--dry-run', *arguments], cwd=ROOT, text=True,
                         capture_output=True, check=False)
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize(('page', 'command'), of('python'))
def test_python(page: Path, command: str) -> None:
    arguments = words(command, 'python')
    if not arguments or not arguments[0].endswith('.py'):
        pytest.skip('no script of the project')
    source = (ROOT / arguments[0]).read_text(encoding='utf-8')
    for flag in (word for word in arguments[1:] if word.startswith('--')):
        assert f"'{flag}'" in source


@pytest.mark.parametrize(('page', 'command'), of('ros2'))
def test_ros2(page: Path, command: str) -> None:
    verb, *arguments = words(command, 'ros2')
    contract = (ROOT / 'docs' / 'contract.md').read_text(encoding='utf-8')
    if verb == 'run':
        assert f'`ros2 run {arguments[0]} {arguments[1]}`' in contract
    elif verb == 'launch':
        launch = (ROOT / 'launch' / arguments[1]).read_text(encoding='utf-8')
        assert all(f"'{word.split(':=')[0]}'" in launch for word in arguments[2:])
    elif verb == 'param' and len(arguments) > 2:
        assert arguments[2] in {p.key for p in configs.parameters()}
    elif verb in ('service', 'topic'):
        name = next(word for word in arguments if word.startswith('/'))
        assert f'`{name.replace("/handeye/", "~/", 1)}`' in contract
