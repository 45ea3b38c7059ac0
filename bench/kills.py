# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Kills a running session at random moments, and counts what is lost of what was acknowledged.

usage: python bench/kills.py [--node] [--count 200] [--seed 0]

The process runs the session of the node, fed directly instead of over ROS. With --node the node
itself is killed: it runs as `ros2 run handeye_ros calibrate` runs it, is fed over DDS, and
acknowledges by the answers of ~/take_sample and ~/remove_last_sample; told is also how long it
took from the start of the process until the samples of the session were on ~/samples, by the
clock. Killed while they start, take, store or remove, both go on with session:=last; ten kills of
a session, then another begins. After each SIGKILL the session has to be readable, by handeye and
by stock readers of rosbag2 and mcap, hold every sample that was acknowledged and not removed, and
go on.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field
import faulthandler
import gc
import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from typing import Any

from handeye_ros.bags.session_files import files_of, read_session
from handeye_ros.bags.writer import cloud_cdr, pose_cdr
from handeye_ros.config import Config, with_values
from handeye_ros.data import Profile, Sample, TimedPose
from handeye_ros.errors import HandeyeError
from handeye_ros.node.folders import OutputFolders, settings_and_session
from handeye_ros.node.live import LiveSession
from handeye_ros.node.pool import Pool
from handeye_ros.sampling.features import result_of
from mcap.reader import make_reader
import numpy as np
from rosbags.highlevel import AnyReader

NS = 1_000_000_000
KILLS_OF_A_SESSION = 10  # then another begins, as reading hundreds of samples takes its time
LONGEST = 0.5  # s until a kill
MAX_OF_NODE = 2.0
WORKING = 0.8  # share of kills of which this time begins with the first acknowledgement
STARTING = 12.0  # s of the others, from the start of a node
PATIENCE = 120.0
SETTINGS = {'target.type': 'sphere', 'target.radius': 0.04, 'sampling.mode': 'manual',
            'sampling.new_translation': 0.0, 'session': 'last'}


@dataclass
class Tally:
    """What is known of a session from what it acknowledged; removing: may be gone or not."""

    taken: set[int] = field(default_factory=set)
    removing: set[int] = field(default_factory=set)
    removed: set[int] = field(default_factory=set)

    def hear(self, text: str) -> None:
        """Take the acknowledgements in a text, one a line; the last may be cut off."""
        for line in text.splitlines(keepends=True):
            if line.endswith('\n'):
                what, number = line.split()
                getattr(self, what).add(int(number))


Kill = Callable[[Path, random.Random, Tally], float]
"""Lets a process work for a while and kills it; hears it, and returns s to restore, 0: unknown."""


def profile(stamp: int) -> Profile:
    """Return a profile across the middle of a sphere of 40 mm radius."""
    x = np.linspace(-0.03, 0.03, 300)
    return Profile(stamp, 'laser', np.column_stack([x, 0.2 - np.sqrt(0.04**2 - x**2)]))


def stop(start: int, place: float) -> Iterator[TimedPose | Profile]:
    """Yield what is seen during a second of a robot that stands still at a place (m)."""
    for stamp in range(start, start + NS, NS // 20):
        yield TimedPose(stamp, np.array([place, 0.2, 0.3]), np.array([0.0, 0.0, 0.0, 1.0]))
        yield profile(stamp + 1)


# -- the session, fed directly


class Inline(Pool):
    """Runs functions in this process, which is killed."""

    def submit(self, function: Any, *args: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(function(*args))
        except HandeyeError as error:
            future.set_exception(error)
        return future


def work(output_dir: Path, acknowledge: int) -> None:
    """Go on with the last session: take samples, and sometimes remove one, for ever."""
    config, found = settings_and_session(SETTINGS | {'output_dir': str(output_dir)},
                                         OutputFolders())
    live = LiveSession(config, OutputFolders(), Inline(), lambda: None)
    if found:
        live.open_session(found, config)
    rng, start = random.Random(), time.time_ns()
    while True:
        start += 2 * NS
        for item in stop(start, rng.uniform(0, 10)):
            if isinstance(item, TimedPose):
                live.add_poses([item])
            else:
                live.add_profile(item)
        live.take_sample()
        number = live.attempt.stop.number
        os.write(acknowledge, f'taken {number}\n'.encode())
        if rng.random() < 0.2:
            os.write(acknowledge, f'removing {number}\n'.encode())
            live.remove_last_sample()
            os.write(acknowledge, f'removed {number}\n'.encode())


def kill_session(output_dir: Path, rng: random.Random, tally: Tally) -> float:
    """Let a process that runs a session work for a while and kill it."""
    ours, its = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(ours)
        try:
            work(output_dir, its)
        except (HandeyeError, OSError):
            traceback.print_exc()
        finally:
            os._exit(1)
    os.close(its)
    # some are killed while they start, most while they work
    said = os.read(ours, 1000) if rng.random() < WORKING else b''
    time.sleep(rng.uniform(0, LONGEST))
    os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    with os.fdopen(ours, 'rb') as stream:
        said += stream.read()
    if os.WTERMSIG(status) != signal.SIGKILL:
        raise SystemExit('the session ended by itself')
    tally.hear(said.decode())
    return 0.0


# -- the node, fed over DDS


class Operator:
    """Feeds a node and asks it, until it is dead."""

    def __init__(self, process: subprocess.Popen[bytes], rng: random.Random, tally: Tally) -> None:
        """Join."""
        from geometry_msgs.msg import PoseStamped
        import rclpy
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from sensor_msgs.msg import PointCloud2
        from std_msgs.msg import String
        from std_srvs.srv import Trigger
        self.started, self.restored, self.tally = time.monotonic(), 0.0, tally
        self.acknowledged = threading.Event()
        self._process, self._rng = process, rng
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = Node('operator', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        deep = QoSProfile(depth=2000)
        self._profiles = self._node.create_publisher(PointCloud2, '/profile', deep)
        self._poses = self._node.create_publisher(PoseStamped, '/flange_pose', deep)
        self._clients = {name: self._node.create_client(Trigger, f'/handeye/{name}')
                         for name in ('take_sample', 'remove_last_sample')}
        self._node.create_subscription(
            String, '/handeye/samples', self._on_samples,
            QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))

    def close(self) -> None:
        """Leave."""
        import rclpy
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _on_samples(self, _: Any) -> None:
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
            number = int(taken.message.split()[1])  # ~/samples has it later, perhaps never
            self.tally.taken.add(number)
            self.acknowledged.set()
            if self._rng.random() < 0.2:
                self.tally.removing.add(number)
                removed = self._asked('remove_last_sample')
                if removed and removed.success:
                    self.tally.removed.add(number)
        self.acknowledged.set()

    def _feed(self, start: int) -> None:
        for item in stop(start, self._rng.uniform(0, 10)):
            if isinstance(item, TimedPose):
                self._poses.publish(pose_cdr(item))
            else:
                self._profiles.publish(cloud_cdr(item))

    def _asked(self, name: str) -> Any:
        """Return the answer of a service, None of a dead node."""
        from std_srvs.srv import Trigger
        future = self._clients[name].call_async(Trigger.Request())
        return future.result() if self._until(future.done) else None


def kill_node(parent: Path, rng: random.Random, tally: Tally) -> float:
    """Let a node work for a while and kill it; return s to restore."""
    given = SETTINGS | {'output_dir': str(parent)}
    words = [word for key, value in given.items() for word in ('-p', f'{key}:={value}')]
    process = subprocess.Popen([sys.executable, '-m', 'handeye_ros.node.calibrate', '--ros-args',
                                *words, '--log-level', 'fatal'])
    operator = Operator(process, rng, tally)
    worker = threading.Thread(target=operator.work)
    worker.start()
    try:
        if rng.random() < WORKING:
            operator.acknowledged.wait(PATIENCE)
            time.sleep(rng.uniform(0, MAX_OF_NODE))
        else:
            time.sleep(rng.uniform(0, STARTING))
        if process.poll() is not None:
            raise SystemExit('the node ended by itself')
    finally:
        process.kill()
        process.wait()
        worker.join()
        operator.close()
        restored = operator.restored
        del operator, worker
        gc.collect()  # what is left of it here, not while the next one spins in another thread
    return restored


# -- both


def check(folder: Path, tally: Tally, config: Config, fewest: int) -> None:
    """
    Raise AssertionError where something acknowledged is lost, or cannot be read.

    fewest: profiles of the newest sample.
    """
    found = read_session(folder)
    lost = tally.taken - tally.removing - set(found.stops)
    assert not lost, f'{folder}: samples {sorted(lost)} are lost'
    back = tally.removed & set(found.stops)
    assert not back, f'{folder}: the removed samples {sorted(back)} are back'
    newest = max(found.stops, default=0)
    if newest:
        sample = result_of(found.stops[newest], config)
        assert isinstance(sample, Sample) and sample.profile_count >= fewest
    for file in files_of(folder):
        with file.open('rb') as stream:
            assert make_reader(stream).get_summary() is not None
    if (folder / 'metadata.yaml').exists():
        with AnyReader([folder]) as reader:
            assert sum(1 for _ in reader.messages()) == reader.message_count


def run(kill: Kill, count: int, seed: int, output_dir: Path) -> None:
    """Kill so many times, and print what is left."""
    rng, taken, removed, starts = random.Random(seed), 0, 0, list[float]()
    config = with_values(Config(), {k: v for k, v in SETTINGS.items() if k != 'session'}, 'kills')
    cloud_cdr(profile(0))  # what is loaded once, the killed processes inherit
    of_node = kill is kill_node
    for begun in range(0, count, KILLS_OF_A_SESSION):
        tally, parent = Tally(), output_dir / f'{begun:04d}'
        for _ in range(min(KILLS_OF_A_SESSION, count - begun)):
            restored = kill(parent, rng, tally)
            starts += [restored] * bool(restored)
            # who is killed between making a folder and its first file leaves an empty one
            folders = [path for path in (parent / 'sphere').glob('*') if files_of(path)]
            assert folders or not tally.taken, f'{parent}: no session is left'
            for folder in folders if tally.taken else ():
                # the service of a node may be asked before all profiles came
                check(folder, tally, config, 1 if of_node else 6)
        taken, removed = taken + len(tally.taken), removed + len(tally.removed)
        line = (f'{min(begun + KILLS_OF_A_SESSION, count)} kills{" of the node" * of_node}: '
                f'{taken} samples acknowledged, {removed} of them removed, none lost')
        if of_node:
            low, median, high = np.percentile(starts or [0.0], (5, 50, 95))
            line += (f'; samples told again {median:.1f} s after the start '
                     f'(5 to 95 %: {low:.1f} to {high:.1f} s)')
        print(line, flush=True)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--node', action='store_true', help='kill the node itself; needs ROS')
    parser.add_argument('--count', type=int, default=200)
    parser.add_argument('--seed', type=int, default=0)
    options = parser.parse_args()
    faulthandler.enable()
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with tempfile.TemporaryDirectory() as folder:
        run(kill_node if options.node else kill_session, options.count, options.seed, Path(folder))


if __name__ == '__main__':
    main()
