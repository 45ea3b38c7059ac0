# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Takes the discovery server away from a node and its client: python lost_server.py FOLDER SERVER.

In a process of its own, as DDS reads ROS_DISCOVERY_SERVER once. Ends with an assertion where
streams and services do not go on.
"""
from __future__ import annotations

from contextlib import closing
import os
from pathlib import Path
import socket
import subprocess
import sys

from command import running
from ros_helpers import Client, pose_message, running_node, sphere_profile

START, PERIOD = 10**18, 50_000_000
SPHERE = ('-p', 'target.type:=sphere', '-p', 'target.radius:=0.04', '-p',
          'sampling.mode:=manual')


def stand(client: Client, start: int) -> None:
    """Send what is seen during a second of a robot that stands still."""
    for stamp in range(start, start + 20 * PERIOD, PERIOD):
        client.poses.publish(pose_message(stamp))
        client.profiles.publish(sphere_profile(stamp + 1))


def main(folder: Path, server: str) -> None:
    """Feed and ask a node with a discovery server and without."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(('127.0.0.1', 0))
        port = str(probe.getsockname()[1])
    os.environ['ROS_DISCOVERY_SERVER'] = f'127.0.0.1:{port}'
    with (running([server, '-i', '0', '-l', '127.0.0.1', '-p', port],
                  stdout=subprocess.DEVNULL) as process,
          running_node(folder, *SPHERE), closing(Client()) as client):
        client.connect()
        stand(client, START)
        client.until_counted(profiles=20, poses=20)
        assert client.call('take_sample').success
        assert client.call('remove_last_sample').success
        process.kill()
        process.wait()
        stand(client, START + 30 * 10**9)
        client.until_counted(profiles=40, poses=40)
        assert 'sample 2 taken' in client.call('take_sample').message
        assert 'removed sample 2' in client.call('remove_last_sample').message
        assert 'no more' not in client.state()['message']


if __name__ == '__main__':
    main(Path(sys.argv[1]), sys.argv[2])
