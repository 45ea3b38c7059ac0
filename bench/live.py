#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
How many profiles a second the node takes without loss, and at what cost, beside an empty one.

usage: python bench/live.py [--rates 1000 2000 3000 4000] [--seconds 10] [--stops]

Publishes profiles of 1280 points (15 kB, best effort) and poses at 125 Hz from a process of its
own, to an empty rclpy subscriber of both topics and to the node, one after the other. Prints for
each rate what was lost, the processor time per profile and the resident memory, and their ratios.
The robot moves all the time; with --stops it stands for 1 s of each 1.5 s, the stops are
extracted, and the calibration is computed again and again meanwhile: for 30 s at least, as that
needs six stops. Needs ROS; on a domain of its own (ROS_DOMAIN_ID).
"""
from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import re
import struct
import subprocess
import sys
import tempfile
import time
from typing import Any

from handeye_ros import se3
from handeye_ros.bags.writer import cloud_cdr, pose_cdr
from handeye_ros.data import Array, Profile, TimedPose
import numpy as np
from scipy.spatial.transform import Rotation

POSES = 125.0  # a second
BEAT = 1e-3  # s between two looks at what is due
COLUMNS = 1280
HERE = Path(__file__)
PLACES, RADIUS, BALL = 60, 0.04, np.array([0.6, 0.1, 0.2])
DOWN = np.diag([1.0, -1.0, -1.0])
T_FLANGE_SENSOR = se3.transform(Rotation.from_euler('xyz', [0.3, -0.2, 0.8]).as_matrix(),
                                np.array([0.05, -0.03, 0.12]))
TICKS = os.sysconf('SC_CLK_TCK')
EMPTY = """
import rclpy, sys
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
rclpy.init()
node, count = Node('empty'), [0]
qos = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)

def on_profile(msg):
    count[0] += 1

def on_pose(msg):
    pass

node.create_subscription(PointCloud2, '/profile', on_profile, qos)
node.create_subscription(PoseStamped, '/flange_pose', on_pose, qos)
node.create_timer(0.2, lambda: print(count[0], flush=True))
try:
    rclpy.spin(node)
except BaseException:
    pass
"""


def publish(rate: float, seconds: float, scene: Scene) -> None:
    """Publish as a driver and a robot do; print how many profiles were sent."""
    from geometry_msgs.msg import PoseStamped
    import rclpy
    from rclpy.node import Node
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import PointCloud2
    rclpy.init()
    node = Node('driver')
    qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
    profiles = node.create_publisher(PointCloud2, '/profile', qos)
    poses = node.create_publisher(PoseStamped, '/flange_pose', QoSProfile(depth=100))
    while not (profiles.get_subscription_count() and poses.get_subscription_count()):
        time.sleep(0.05)
    time.sleep(1.0)
    start, sent, posed = time.time_ns(), 0, 0
    while (now := time.time_ns() - start) < seconds * 1e9:
        # after a while in which the machine stood still, it catches up at twice the rate: more at
        # once does not fit into the memory that DDS shares, and no sensor sends more
        due = min(int(now * 1e-9 * rate), sent + max(2, round(2 * BEAT * rate)))
        while sent < due:
            profiles.publish(stamped(scene.cloud(sent / rate), start + round(sent * 1e9 / rate)))
            sent += 1
        while posed < now * 1e-9 * POSES:
            stamp = start + round(posed * 1e9 / POSES)
            poses.publish(pose_cdr(scene.pose(stamp, posed / POSES)))
            posed += 1
        time.sleep(max(BEAT * 0.9 if due < int(now * 1e-9 * rate) else 0.0,
                       (sent + 1) / rate - (time.time_ns() - start) * 1e-9))
    print(sent, flush=True)
    time.sleep(1.0)
    rclpy.shutdown()


def stamped(message: bytes, stamp: int) -> bytes:
    """Return a serialised message with another stamp."""
    return message[:4] + struct.pack('<iI', *divmod(stamp, 1_000_000_000)) + message[12:]


def flange_of(place: Array) -> tuple[Array, Array]:
    """Return translation and quaternion of the flange from which the sphere is at a place (6,)."""
    turn = DOWN @ Rotation.from_euler('ZXY', place[3:]).as_matrix()
    T = se3.transform(turn, BALL - turn @ place[:3]) @ se3.inverse(T_FLANGE_SENSOR)
    return T[:3, 3], se3.quaternion(T)


class Scene:
    """A sphere, and a robot that goes round it; cycle: s from stop to stop, 0 for no stops."""

    def __init__(self, cycle: float) -> None:
        """Draw the places, and what is seen at each."""
        rng = np.random.default_rng(0)
        self._cycle = cycle
        # where the sphere is in the sensor's frame, and how this is turned
        drawn = np.column_stack([
            rng.uniform(-0.01, 0.01, (PLACES, 2)), rng.uniform(0.22, 0.26, PLACES),
            rng.uniform(-1, 1, (PLACES, 3)) * [1.5, 0.4, 0.4]])
        self._poses = [flange_of(place) for place in drawn]
        self._clouds = [cloud_of(place[:3], rng) for place in drawn]

    def cloud(self, t: float) -> bytes:
        """Return the message of the profile at a time t (s)."""
        return self._clouds[int(t / (self._cycle or 1.0)) % PLACES]

    def pose(self, stamp: int, t: float) -> TimedPose:
        """Return where the robot is: it stands for two thirds of a cycle, if any."""
        number, inside = divmod(t / (self._cycle or 1.0), 1.0)
        way = inside if not self._cycle else max(0.0, inside - 2 / 3) * 3
        (here, turn), (there, turned) = (self._poses[int(number + k) % PLACES] for k in (0, 1))
        turned = turned if turn @ turned >= 0 else -turned
        mixed = (1 - way) * turn + way * turned
        return TimedPose(stamp, (1 - way) * here + way * there, mixed / np.linalg.norm(mixed))


def cloud_of(centre: Array, rng: np.random.Generator) -> bytes:
    """Return the message of a profile across the sphere with its centre (3,) in the sensor."""
    x = np.linspace(-0.03, 0.03, COLUMNS)
    inside = RADIUS ** 2 - centre[1] ** 2 - (x - centre[0]) ** 2
    z = centre[2] - np.sqrt(np.where(inside > 0, inside, np.nan))
    points = np.column_stack([x, z + rng.normal(0, 2e-5, COLUMNS)])
    return cloud_cdr(Profile(1, 'laser', points))


@contextmanager
def listener(kind: str, folder: str) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """Run the empty subscriber, or the node; what it prints goes to a file."""
    log = Path(folder) / f'{kind}.log'
    node = ['-m', 'handeye_ros.node.calibrate', '--ros-args', '-p', 'target.type:=sphere', '-p',
            'target.radius:=0.04', '-p', f'output_dir:={folder}']
    with log.open('w') as stream:
        process = subprocess.Popen(
            [sys.executable, *(['-c', EMPTY] if kind == 'empty' else node)],
            stdout=stream, stderr=subprocess.STDOUT, text=True,
            env={**os.environ, 'ROS_HOME': folder})
        try:
            yield process, log
        finally:
            process.terminate()
            process.wait(30)


def usage(pid: int) -> tuple[float, float]:
    """Return the processor time (s) and the resident memory (MB; none as it ends) of a process."""
    fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    status = Path(f'/proc/{pid}/status').read_text()
    resident = re.search(r'VmRSS:\s+(\d+)', status)
    return ((int(fields[11]) + int(fields[12])) / TICKS,
            int(resident[1]) / 1024 if resident else 0.0)


class Watcher:
    """Counts what the node says that it received, and asks it to solve."""

    def __init__(self) -> None:
        """Join."""
        from diagnostic_msgs.msg import DiagnosticArray
        import rclpy
        from rclpy.node import Node
        from std_srvs.srv import Trigger
        rclpy.init()
        self._node = Node('bench')
        self._state: dict[str, str] = {}
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._on_state, 10)
        self._solve = self._node.create_client(Trigger, '/handeye/compute_calibration')
        self._asked: Any = None
        self.solves = 0

    def _on_state(self, msg: Any) -> None:
        self._state = {pair.key: pair.value for status in msg.status for pair in status.values}

    def count(self) -> int:
        """Return the profiles that have come so far."""
        return int(self._state.get('profiles', -1)) + int(self._state.get('malformed messages', 0))

    def forget(self) -> None:
        """Expect no answer any more, and no count."""
        self._asked, self._state = None, {}

    def wait(self, seconds: float, solving: bool) -> None:
        """Listen for some time; solving: one calibration after the other is asked for."""
        import rclpy
        from std_srvs.srv import Trigger
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            rclpy.spin_once(self._node, timeout_sec=0.1)
            # a request that no node hears is never answered
            if solving and self._solve.service_is_ready() and (
                    self._asked is None or self._asked.done()):
                self.solves += self._asked is not None and self._asked.result().success
                self._asked = self._solve.call_async(Trigger.Request())


def run(kind: str, rate: float, options: argparse.Namespace, watcher: Watcher
        ) -> tuple[float, float, float, float]:
    """Return rate sent, share lost, processor ms per profile and memory (MB) of a listener."""
    with tempfile.TemporaryDirectory() as folder, listener(kind, folder) as (process, log):
        watcher.forget()  # what a node that has ended was asked
        watcher.wait(3.0, False)
        arguments = ['--publish', str(rate), '--seconds', str(options.seconds)]
        before, _ = usage(process.pid)
        arguments += ['--stops'] if options.stops else []
        with subprocess.Popen([sys.executable, HERE, *arguments], stdout=subprocess.PIPE,
                              text=True) as driver:
            while driver.poll() is None and process.poll() is None:
                watcher.wait(0.2, options.stops and kind == 'node')
            sent = int(driver.stdout.read())
        watcher.wait(4.0, False)
        after, memory = usage(process.pid)
        got = watcher.count() if kind == 'node' else int(log.read_text().split()[-1])
    return sent / options.seconds, 1 - got / sent, 1e3 * (after - before) / max(1, got), memory


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--rates', type=float, nargs='+', default=[1000, 2000, 3000, 4000])
    parser.add_argument('--seconds', type=float, default=10.0)
    parser.add_argument('--stops', action='store_true')
    parser.add_argument('--publish', type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.stops:  # long enough for many solves
        options.seconds = max(options.seconds, 30.0)
    if options.publish:
        publish(options.publish, options.seconds, Scene(1.5 if options.stops else 0.0))
        return
    watcher = Watcher()
    for rate in options.rates:
        costs = {}
        watcher.solves = 0
        for kind in ('empty', 'node'):
            sent, lost, costs[kind], memory = run(kind, rate, options, watcher)
            print(f'{kind:6} {sent:6.0f}/s sent, {100 * lost:6.2f} % lost, {costs[kind]:.3f} ms '
                  f'each, {memory:.0f} MB', flush=True)
        print(f'at {rate:.0f}/s the node takes {costs["node"] / costs["empty"]:.2f} times the '
              'processor time of the empty one', flush=True)
        if options.stops:
            print(f'meanwhile {watcher.solves} solves', flush=True)


if __name__ == '__main__':
    main()
