# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A colcon workspace: built, sourced, and the node started from it, as on a ROS machine."""
from __future__ import annotations

from importlib.metadata import version
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import sysconfig
import xml.etree.ElementTree as ElementTree

import handeye_ros
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
pytest.importorskip('colcon_core', reason='needs colcon')
from command import run_python, running  # noqa: E402, I100

pytestmark = pytest.mark.ros

NAME = 'handeye_ros'
ROOT = Path(__file__).parents[1]
DATA = ('launch', 'config', 'rviz', 'foxglove')


def environment() -> dict[str, str]:
    """Return the environment of a terminal in which ROS is sourced."""
    variables = dict(os.environ)
    if variables.pop('_ROS_WHEELS_BOOTSTRAP_COMPLETE', None):  # meant for this process alone
        del variables['LD_LIBRARY_PATH']
    return {'AMENT_PREFIX_PATH': sys.prefix, **variables}


def copy_sources(folder: Path) -> None:
    """Copy what git tracks, or would."""
    listed = subprocess.run(
        ['git', 'ls-files', '-z', '--cached', '--others', '--exclude-standard'],
        cwd=ROOT, capture_output=True, text=True, check=True)
    for name in filter(None, listed.stdout.split('\0')):
        if (ROOT / name).exists():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)


@pytest.fixture(scope='module')
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a workspace with colcon."""
    folder = tmp_path_factory.mktemp('workspace')
    copy_sources(folder / 'src' / NAME)
    build = run_python('-m', 'colcon', 'build', '--packages-select', NAME, cwd=folder,
                       env=environment())
    assert build.returncode == 0, build.stdout + build.stderr
    assert 'Summary: 1 package finished' in build.stdout
    return folder


def share(workspace: Path) -> Path:
    return workspace / 'install' / NAME / 'share' / NAME


def test_what_is_no_code_is_installed(workspace: Path) -> None:
    (code,) = (workspace / 'install').glob(f'**/site-packages/{NAME}')
    for source, place in (*((ROOT / name, share(workspace) / name) for name in DATA),
                          *((ROOT / NAME / name, code / name)
                            for name in ('page/assets', 'results/assets',
                                         'simulate/assets'))):
        expected = {file.name: file.read_bytes() for file in source.glob('*.*')}
        assert expected
        assert {file.name: file.read_bytes() for file in place.iterdir()} == expected


def test_the_installed_node_answers(workspace, tmp_path, client):
    dump = subprocess.run(
        ['bash', '-c', 'source install/setup.bash && env -0'],
        cwd=workspace, env=environment(), capture_output=True, text=True, check=True)
    sourced = dict(line.split('=', 1) for line in dump.stdout.split('\0') if line)
    command = [workspace / 'install' / NAME / 'lib' / NAME / 'calibrate', '--ros-args',
               '--params-file', share(workspace) / 'config' / 'plate.yaml']
    with ((tmp_path / 'log').open('w', encoding='utf-8') as output,
          running(command, signal.SIGINT, cwd=tmp_path, env=sourced, stdout=output,
                  stderr=subprocess.STDOUT) as node):
        response = client.call('compute_calibration')
        assert not response.success  # nothing moves here, and it says so
        assert '/flange_pose' in response.message
        assert node.poll() is None


def test_the_version_is_the_same_everywhere() -> None:
    manifest = ElementTree.parse(ROOT / 'package.xml')
    assert manifest.findtext('version') == version(NAME) == handeye_ros.__version__


def built(code: str, folder: Path, cwd: Path) -> Path:
    """Return what a call of setuptools makes in a folder."""
    run = run_python('-c', f'import setuptools.build_meta as build; print(build.{code})',
                     folder, cwd=cwd, env=environment())
    assert run.returncode == 0, run.stderr
    return folder / run.stdout.splitlines()[-1]


@pytest.fixture(scope='module')
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a wheel that is built from the sdist, with nothing else at hand."""
    folder = tmp_path_factory.mktemp('dist')
    copy_sources(folder / 'clone')
    sdist = built('build_sdist(__import__("sys").argv[1])', folder, folder / 'clone')
    shutil.unpack_archive(sdist, folder / 'unpacked')
    (source,) = (folder / 'unpacked').iterdir()
    return built('build_wheel(__import__("sys").argv[1])', folder, source)


@pytest.mark.thorough
def test_a_clean_environment_gets_all_that_users_need(wheel: Path, tmp_path: Path) -> None:
    venv = tmp_path / 'venv'
    subprocess.run([sys.executable, '-m', 'venv', '--without-pip', venv], check=True)
    subprocess.run([sys.executable, '-m', 'pip', '--python', venv, 'install', '--quiet',
                    '--no-deps', '--no-index', wheel], env=environment(), check=True)
    for folder in DATA:
        expected = {file.name for file in (ROOT / folder).glob('*.*')}
        installed = venv / 'share' / NAME / folder
        assert expected and {file.name for file in installed.glob('*.*')} == expected
    # what it depends on comes from here; a .pth file in a folder of PYTHONPATH is not read, so
    # the package itself does not
    kept = {**environment(), 'PYTHONPATH': sysconfig.get_path('purelib')}
    handeye = venv / 'bin' / 'handeye'
    for arguments in (['solve', ROOT / 'bags' / 'plate', '--config',
                       venv / 'share' / NAME / 'config' / 'plate.yaml', '--out', 'out'],
                      ['export', 'out', '--format', 'urdf'], ['report', 'out'], ['--version']):
        run = subprocess.run([handeye, *arguments], cwd=tmp_path, env=kept, capture_output=True,
                             text=True, check=False)
        assert run.returncode == 0, run.stderr
    assert run.stdout == f'{NAME} {version(NAME)}\n'
    assert (tmp_path / 'out' / 'report.html').stat().st_size > 100_000
    code = f'import {NAME}; print({NAME}.__file__)'
    where = subprocess.run([venv / 'bin' / 'python', '-c', code], cwd=tmp_path, env=kept,
                           capture_output=True, text=True, check=True)
    assert Path(where.stdout.strip()).is_relative_to(venv)
