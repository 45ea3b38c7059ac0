# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Every command line of the README and the docs is run, or its names are looked up."""
from __future__ import annotations

import ast
from collections.abc import Iterator
import importlib.util
from pathlib import Path
import re
import shlex
import shutil
import subprocess

from command import handeye, ROOT, run_python
from handeye_ros import config as configs
import pytest

pytestmark = pytest.mark.once

PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted((ROOT / 'docs').glob('*.md'))]
PROGRAM = re.compile(r'^(?:\$ )?(?:[A-Z_]+=\S+ )*(?:\.venv/bin/)?'
                     r'(handeye|make|ros2|python)(?= [-\w./]+(?: |$))')
STANDS_FOR = {'path/to/bag': 'bags/plate'}
# Other tests run these; the first two do not end, the last two need a recording from elsewhere.
ELSEWHERE = ('handeye replay', 'handeye calibrate', 'handeye kinematics path/to',
             'handeye batch out/cell', 'handeye batch jobs.csv',
             'handeye compare path/to/sphere_r40', 'handeye solve path/to/sphere_r40')
THERE = {  # what a page takes as there: what makes it, in the folder "made"
    'calibration.yaml': 'handeye solve bags/plate --config config/plate.yaml --out made'}


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
    arguments = shlex.split(command)
    return arguments[arguments.index(program) + 1:]


def commands_of(program: str) -> dict[Path, list[str]]:
    """Return the commands of a program on each page that has some, each once."""
    texts_of = {page: [text for text in dict.fromkeys(commands(page))
                       if PROGRAM.match(text)[1] == program] for page in PAGES}
    return {page: texts for page, texts in texts_of.items() if texts}


def each(program: str) -> list[object]:
    """Return (command) of all commands of a program."""
    return [pytest.param(text, id=f'{page.stem}: {text}')
            for page, texts in commands_of(program).items() for text in texts]


def run_well(command: str, folder: Path) -> None:
    command, _, code = command.partition('# exit code ')
    run = handeye(*words(command, 'handeye'), cwd=folder)
    assert run.returncode == int(code or 0), f'{command}: {run.stderr}'


@pytest.mark.thorough
@pytest.mark.parametrize('page', commands_of('handeye'), ids=lambda page: page.stem)
def test_the_handeye_commands_of_a_page_run(page: Path, tmp_path: Path) -> None:
    """Run the commands of a page one after another in a folder with what a clone holds."""
    texts = [text for text in commands_of('handeye')[page] if not text.startswith(ELSEWHERE)]
    for name in ('bags', 'config'):
        (tmp_path / name).symlink_to(ROOT / name)
    for file in sorted({word for text in texts for word in shlex.split(text)} & THERE.keys()):
        run_well(THERE[file], tmp_path)
        (tmp_path / 'made' / file).rename(tmp_path / file)
        shutil.rmtree(tmp_path / 'made')
    for command in texts:
        run_well(command, tmp_path)


@pytest.mark.parametrize('command', each('make'))
def test_make_knows_what_a_page_makes(command: str) -> None:
    arguments = [word for word in words(command, 'make') if word.split('=')[0].isidentifier()]
    run = subprocess.run(['make', '--dry-run', *arguments], cwd=ROOT, text=True,
                         capture_output=True, check=False)
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize('command', each('ros2'))
def test_what_ros2_is_told_is_in_the_contract(command: str) -> None:
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


def test_the_site_builds(tmp_path: Path) -> None:
    """No link leads nowhere."""
    pytest.importorskip('mkdocs', reason='needs mkdocs')
    run = run_python('-m', 'mkdocs', 'build', '--quiet', '--strict', '--site-dir', tmp_path)
    assert run.returncode == 0, run.stdout + run.stderr
    pages = {path.stem for path in (ROOT / 'docs').glob('*.md')} - {'index'}
    assert all((tmp_path / page / 'index.html').is_file() for page in pages)
    assert 'start' in (tmp_path / 'index.html').read_text(encoding='utf-8')


@pytest.mark.parametrize('file', sorted([*ROOT.glob('bench/*.py'), *ROOT.glob('tools/*.py')]),
                         ids=lambda file: file.name)
def test_what_a_bench_or_tool_imports_is_there(file: Path) -> None:
    for node in ast.walk(ast.parse(file.read_text(encoding='utf-8'))):
        if isinstance(node, ast.ImportFrom) and (node.module or '').startswith('handeye_ros'):
            room = importlib.import_module(node.module)
            for name in node.names:
                assert hasattr(room, name.name) or importlib.util.find_spec(
                    f'{node.module}.{name.name}'), f'{node.module}: {name.name}'
