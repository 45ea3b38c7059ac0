# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A disk that is full or gone under a running node, and a node that is killed: nothing is lost."""
from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import re
import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from handeye_ros.bags.session import read_session  # noqa: E402, I100
from ros_helpers import (  # noqa: E402
    Client,
    pose_message,
    ROOT,
    running_node,
    sphere_profile,
)

pytestmark = pytest.mark.ros

NS = 1_000_000_000
SPHERE = ('-p', 'target.type:=sphere', '-p', 'target.radius:=0.04', '-p',
          'sampling.mode:=manual', '-p', 'profile_topic:=/profile', '-p',
          'pose_topic:=/flange_pose')


def mount(*arguments: object) -> bool:
    """Tell whether mount, which only root may call, succeeds."""
    try:
        return subprocess.run(['mount', *map(str, arguments)], capture_output=True,
                              check=False).returncode == 0
    except FileNotFoundError:
        return False


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """Give a disk of its own, of half a megabyte."""
    place = tmp_path / 'disk'
    place.mkdir()
    if not mount('-t', 'tmpfs', '-o', 'size=512k', 'tmpfs', place):
        pytest.skip('needs to mount a file system')
    yield place
    subprocess.run(['umount', '-l', place], capture_output=True, check=False)


def stand_still(client: Client, count: int) -> None:
    """Publish another stop of the robot, the count-th."""
    start = 10**18 + 5 * count * NS
    for stamp in range(start, start + NS, NS // 20):
        client.poses.publish(pose_message(stamp, (0.1 * count, 0.0, 0.0)))
        client.profiles.publish(sphere_profile(stamp + 1))
    client.until_counted(profiles=20 * count, poses=20 * count)


def filled(disk: Path) -> Path:
    """Fill a disk; return the file that does."""
    filler = disk / 'filler'
    with filler.open('wb', buffering=0) as stream, pytest.raises(OSError, match='No space'):
        while True:
            stream.write(bytes(4096))
    return filler


def refused(client: Client, words: str) -> None:
    answer = client.call('take_sample')
    assert (answer.success, words in answer.message) == (False, True), answer.message
    assert words in client.state()['message']


@pytest.mark.thorough
def test_nothing_acknowledged_is_lost_by_kills_of_the_node() -> None:
    run = subprocess.run([sys.executable, 'bench/kills.py', '--node', '--count', '4'], cwd=ROOT,
                         text=True, capture_output=True, check=False)
    assert run.returncode == 0, run.stderr
    result = re.match(r'4 kills of the node: (\d+) samples acknowledged, \d+ of them removed, '
                      'none lost', run.stdout.splitlines()[-1])
    assert result and int(result[1]) >= 2, run.stdout


@pytest.mark.thorough
def test_what_is_not_stored_is_not_taken(tmp_path: Path, client: Client, disk: Path) -> None:
    with running_node(tmp_path, *SPHERE, '-p', f'output_dir:={disk}') as process:
        client.connect()
        stand_still(client, 1)
        assert client.call('take_sample').success
        folder = next((disk / 'sphere').iterdir())
        filler = filled(disk)
        stand_still(client, 2)
        refused(client, 'No space left on device')
        assert sorted(read_session(folder).stops) == [1]
        filler.unlink()
        assert client.call('take_sample').success
        assert mount('-o', 'remount,ro', disk)
        stand_still(client, 3)
        refused(client, 'Read-only file system')
        assert mount('-o', 'remount,rw', disk)
        assert client.call('take_sample').success
        assert sorted(read_session(folder).stops) == [1, 2, 3]
        subprocess.run(['umount', '-l', disk], check=True)
        stand_still(client, 4)
        refused(client, 'its folder is gone (unmounted or removed?)')
        assert client.state()['samples'] == '3'
        assert process.poll() is None
    log = (tmp_path / 'node.log').read_text()
    assert 'Traceback' not in log and 'No space left on device' in log
