# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What users rely on is there: every name of docs/contract.md, and the public Python API."""
from __future__ import annotations

import contextlib
import io
from pathlib import Path
import pkgutil
import re
import runpy
import xml.etree.ElementTree as ElementTree

import handeye_ros
from handeye_ros import config as configs
from handeye_ros.cli import command
from handeye_ros.config import SOLVED_FROM_FILES
from handeye_ros.tabulated import FILE_TARGETS
from handeye_ros.targets import TARGETS
import pytest
import typer.main
import yaml

pytestmark = pytest.mark.once

ROOT = Path(__file__).parents[1]
CONTRACT = (ROOT / 'docs' / 'contract.md').read_text(encoding='utf-8')
LIBRARY = (ROOT / 'docs' / 'library.md').read_text(encoding='utf-8')


def section(title: str) -> str:
    """Return the text of a section of the contract."""
    return CONTRACT.split(f'\n## {title}\n', 1)[1].split('\n## ', 1)[0]


def names(text: str) -> list[str]:
    quoted = re.findall(r'`([^`]+)`', text)
    assert quoted
    return quoted


def test_the_verbs_are_those_listed() -> None:
    commands = typer.main.get_command(command()).commands  # type: ignore[attr-defined]
    verbs = {name.removeprefix('handeye ') for name in names(section('Verbs of the command line'))}
    assert verbs == set(commands)


def test_the_executables_are_those_listed() -> None:
    setup = (ROOT / 'setup.py').read_text(encoding='utf-8')
    listed = {name.rsplit(' ', 1)[1] for name in names(section('Executables'))}
    assert listed == set(re.findall(r"'(\w+) = handeye_ros\.", setup))


@pytest.mark.parametrize('name', [n for n in names(section('Python')) if '.' in n])
def test_what_programs_import_is_there(name: str) -> None:
    assert callable(pkgutil.resolve_name(name))


def test_ros_packages_that_are_imported_are_dependencies() -> None:
    listed = {item.text for item in ElementTree.parse(ROOT / 'package.xml').iter('exec_depend')}
    code = '\n'.join(file.read_text(encoding='utf-8') for folder in ('handeye_ros', 'launch')
                     for file in (ROOT / folder).rglob('*.py'))
    imported = set(re.findall(r'^ *(?:from|import) (\w+)', code, re.MULTILINE))
    assert {name for name in imported if name in ('rclpy', 'launch', 'launch_ros')
            or name.endswith(('_msgs', '_srvs', '_interfaces'))} <= listed


def test_the_launch_files_are_those_listed() -> None:
    listed = {name for name in names(section('Launch files')) if name.endswith('.launch.py')}
    assert listed == {file.name for file in (ROOT / 'launch').glob('*.launch.py')}


def test_keys_and_targets_are_those_listed() -> None:
    keys, targets = section('Keys').split('Targets:')
    known = {parameter.key for parameter in configs.parameters()}
    assert set(names(keys)) == known
    assert set(names(targets)) == TARGETS.keys() | FILE_TARGETS.keys()
    assert set(SOLVED_FROM_FILES) == FILE_TARGETS.keys()


def test_the_reference_tells_every_key() -> None:
    make = runpy.run_path(str(ROOT / 'tools' / 'make_reference.py'))
    page = (ROOT / 'docs' / 'reference.md').read_text(encoding='utf-8')
    assert page == make['reference'](), 'make figures writes docs/reference.md anew'


def test_the_public_names_are_those_listed() -> None:
    listed = set(names('\n'.join(row.split('|')[1] for row in LIBRARY.splitlines()
                                 if row.startswith('| `'))))
    assert listed == set(handeye_ros.__all__)
    assert all(getattr(handeye_ros, name) for name in listed)
    with pytest.raises(AttributeError, match='has no attribute'):
        _ = handeye_ros.nonsense


def test_the_example_prints_what_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code, printed = re.findall(r'```(?:python|text)\n(.*?)```', LIBRARY, re.DOTALL)
    for folder in ('config', 'bags'):
        (tmp_path / folder).symlink_to(ROOT / folder)
    monkeypatch.chdir(tmp_path)
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        exec(compile(code, 'library.md', 'exec'), {})
    assert output.getvalue() == printed
    fields = names(section('Files').split('fields', 1)[1].split('.', 1)[0])
    written = yaml.safe_load((tmp_path / 'out' / 'calibration.yaml').read_text(encoding='utf-8'))
    assert written['format'] in names(section('Files'))
    assert set(fields) <= written.keys()


def test_every_source_file_states_copyright_and_licence() -> None:
    for folder in ('handeye_ros', 'launch', 'bench', 'tools', 'test'):
        for file in (ROOT / folder).rglob('*'):
            if file.suffix in ('.py', '.sh', '.js', '.css', '.html', '.jinja'):
                head = file.read_text(encoding='utf-8')[:300]
                assert 'Copyright 2026' in head and 'SPDX-License-Identifier' in head, file
