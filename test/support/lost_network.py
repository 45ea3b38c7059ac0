# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The network of a running node goes and comes back: python lost_network.py FOLDER.

To be run in a network of its own (unshare --net), as root, with FASTDDS_BUILTIN_TRANSPORTS=UDPv4
and ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET: messages in shared memory would not miss the network.
"""
from __future__ import annotations

from itertools import count
from pathlib import Path
import subprocess
import sys

from ros_helpers import Client, pose_message, running_node, sphere_profile


def link(way: str) -> None:
    """Set the only interface up or down."""
    subprocess.run(['ip', 'link', 'set', 'lo', way], check=True)


def main(folder: Path) -> None:
    """Fail where the node does not tell, or does not hear again."""
    link('up')
    client, stamps = Client(), count(10**18, 50_000_000)

    def send() -> bool:
        stamp = next(stamps)
        client.profiles.publish(sphere_profile(stamp))
        client.poses.publish(pose_message(stamp))
        return True

    with running_node(folder):
        client.connect()
        client.until(lambda: send() and client.state()['profiles'] != '0', 'it hears')
        link('down')
        client.until(lambda: send() and 'no more profiles' in (folder / 'node.log').read_text(),
                     'it tells that nothing comes')
        link('up')
        client.until(lambda: send() and 'no more' not in client.state()['message'],
                     'it hears again')
    client.close()


if __name__ == '__main__':
    main(Path(sys.argv[1]))
