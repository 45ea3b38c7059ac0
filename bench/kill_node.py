# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Kills the node itself at random moments, and counts what is lost of what was acknowledged.

    .venv/bin/python bench/kill_node.py [--count 200] [--seed 0]

The node runs as `ros2 run handeye_ros calibrate` runs it, is fed over DDS, and acknowledges by the
answers of ~/take_sample and ~/remove_last_sample. It is killed while it starts, takes, stores or
removes, and goes on with session:=last; ten kills of a session, then another begins. After each
kill what bench/kills.py checks. Told at the end: how long it took from the start of the process
until the samples of the session were on ~/samples, by the clock.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable
import faulthandler
import gc
import os
from pathlib import Path
import random
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any

from geometry_msgs.msg import PoseStamped
from handeye_ros.bags.bag_write import cloud_cdr
from handeye_ros.config import Config, with_values
from handeye_ros.data import TimedPose
from kills import check, KILLS_OF_A_SESSION, NS, profile, SETTINGS, stop, Tally
import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from std_srvs.srv import Trigger

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
DEEP = QoSProfile(depth=2000)
LONGEST = 2.0  # s until a kill
WORKING = 0.8  # share of kills of which this time begins with the first acknowledgement
STARTING = 12.0  # s of the others, from the start of the process
PATIENCE = 120.0


class Operator:
    """Feeds a node and asks it, until it is dead."""

    def __init__(self, process: subprocess.Popen[bytes], rng: random.Random) -> None:
        self.started = time.monotonic()
        self._process, self._rng = process, rng
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = Node('operator', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._profiles = self._node.create_publisher(PointCloud2, '/profile', DEEP)
        self._poses = self._node.create_publisher(PoseStamped, '/flange_pose', DEEP)
        self._clients = {name: self._node.create_client(Trigger, f'/handeye/{name}')
                         for name in ('take_sample', 'remove_last_sample')}
        self._node.create_subscription(String, '/handeye/samples', self._on_samples, LATCHED)
        self.tally, self.restored = Tally(), 0.0
        self.acknowledged = threading.Event()

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _on_samples(self, _: String) -> None:
        self.restored = self.restored or time.monotonic() - self.started

    def _until(self, condition: Callable[[], Any]) -> bool:
        """Spin until a condition holds; tell whether it does: a dead node fulfils none."""
        end = time.monotonic() + PATIENCE
        while not condition():
            if self._process.poll() is not None or time.monotonic() > end:
                return False
            self._executor.spin_once(timeout_sec=0.005)
        return True

    def work(self) -> None:
        """Take samples, and sometimes remove one, as long as the node lives."""
        there = self._until(lambda: self._profiles.get_subscription_count()
                            and self._poses.get_subscription_count() and self.restored
                            and all(c.service_is_ready() for c in self._clients.values()))
        start = time.time_ns()
        while there and self._process.poll() is None:
            start += 2 * NS
            self._feed(start)
            taken = self._asked('take_sample')
            if taken is None or not taken.success:
                continue
            number = int(taken.message.split()[1])
            self.tally.taken.add(number)
            self.acknowledged.set()
            if self._rng.random() < 0.2:
                self.tally.removing.add(number)
                removed = self._asked('remove_last_sample')
                if removed and removed.success:
                    self.tally.removed.add(int(removed.message.split()[2].rstrip(',')))
        self.acknowledged.set()

    def _feed(self, start: int) -> None:
        for item in stop(start, self._rng.uniform(0, 10)):
            if isinstance(item, TimedPose):
                msg = PoseStamped()
                msg.header.frame_id = 'base'
                msg.header.stamp.sec, msg.header.stamp.nanosec = divmod(item.stamp, NS)
                p, q = msg.pose.position, msg.pose.orientation
                p.x, p.y, p.z = map(float, item.translation)
                q.x, q.y, q.z, q.w = map(float, item.quaternion)
                self._poses.publish(msg)
            else:
                self._profiles.publish(deserialize_message(
                    cloud_cdr(item, Config()), PointCloud2))

    def _asked(self, name: str) -> Any:
        """Return the answer of a service, None of a dead node."""
        future = self._clients[name].call_async(Trigger.Request())
        return future.result() if self._until(future.done) else None


def killed(parent: Path, rng: random.Random) -> tuple[Tally, float]:
    """Let a node work for a while and kill it; return what it acknowledged, and s to restore."""
    given = SETTINGS | {'output_dir': str(parent)}
    words = [word for key, value in given.items() for word in ('-p', f'{key}:={value}')]
    process = subprocess.Popen([sys.executable, '-m', 'handeye_ros.node', '--ros-args', *words,
                                '--log-level', 'fatal'])
    operator = Operator(process, rng)
    worker = threading.Thread(target=operator.work)
    worker.start()
    try:
        if rng.random() < WORKING:
            operator.acknowledged.wait(PATIENCE)
            time.sleep(rng.uniform(0, LONGEST))
        else:
            time.sleep(rng.uniform(0, STARTING))
        if process.poll() is not None:
            raise SystemExit('the node ended by itself')
    finally:
        process.kill()
        process.wait()
        worker.join()
        operator.close()
        report = operator.tally, operator.restored
        del operator, worker
        gc.collect()  # what is left of it here, not while the next one spins in another thread
    return report


def run(count: int, seed: int, output_dir: Path) -> None:
    rng, taken, removed, starts = random.Random(seed), 0, 0, []
    config = with_values(Config(), {k: v for k, v in SETTINGS.items() if k != 'session'}, 'kills')
    cloud_cdr(profile(0), config)
    for begun in range(0, count, KILLS_OF_A_SESSION):
        tally, parent = Tally(), output_dir / f'{begun:04d}'
        for _ in range(min(KILLS_OF_A_SESSION, count - begun)):
            report, restored = killed(parent, rng)
            for name in ('taken', 'removing', 'removed'):
                getattr(tally, name).update(getattr(report, name))
            starts += [restored] * bool(restored)
            for folder in (parent / 'sphere').glob('*') if tally.taken else ():
                check(folder, tally, config, 1)  # the service may be asked before all came
        taken, removed = taken + len(tally.taken), removed + len(tally.removed)
        low, median, high = np.percentile(starts or [0.0], (5, 50, 95))
        print(f'{min(begun + KILLS_OF_A_SESSION, count)} kills of the node: {taken} samples '
              f'acknowledged, {removed} of them removed, none lost; samples told again '
              f'{median:.1f} s after the start (5 to 95 %: {low:.1f} to {high:.1f} s)', flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--count', type=int, default=200)
    parser.add_argument('--seed', type=int, default=0)
    options = parser.parse_args()
    faulthandler.enable()
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with tempfile.TemporaryDirectory() as folder:
        run(options.count, options.seed, Path(folder))


if __name__ == '__main__':
    main()
