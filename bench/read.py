#!/usr/bin/env python3
"""
How fast bags are read, as ratios to a bare reader, and what memory a whole solve takes.

usage: python bench/read.py [--minutes 1 10] [--no-solve]

Makes bags of 1280-point profiles at 100 Hz and poses at 500 Hz as rosbag2 does (mcap, no
compression, chunks of 768 KiB). Prints for the shortest the seconds of a bare rosbags loop, once
without and once with deserialising, and of our reading, which also says what every message is and
puts them in order; then for each length the time and the peak memory of `handeye solve`. Seconds
are of the processor, so that other work on the machine does not count.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
import resource
import struct
import subprocess
import sys
import tempfile
import time

from handeye_ros.bags import bag
from handeye_ros.bags.bag_write import LAYOUTS, serialised
from handeye_ros.config import Config, load
from handeye_ros.data import Profile, TimedPose
from handeye_ros.simulate import SCENARIOS, simulate
from mcap.writer import CompressionType, Writer
import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_typestore, Stores

CONFIG = Path(__file__).parents[1] / 'config' / 'plate.yaml'
PROFILES, POSES = 100.0, 500.0  # a second
CHUNK = 768 * 1024
TOPICS = {'/profile': 'sensor_msgs/msg/PointCloud2',
          '/flange_pose': 'geometry_msgs/msg/PoseStamped'}


def make(path: Path, minutes: float) -> None:
    """Write a bag of so many minutes: a simulated robot that goes its way again and again."""
    messages = one_run()
    length = messages[-1][1] - messages[0][1] + round(1e9 / POSES)
    with path.open('wb') as stream:
        writer = Writer(stream, chunk_size=CHUNK, compression=CompressionType.NONE)
        writer.start('ros2')
        channels = {topic: writer.register_channel(
            topic, 'cdr', writer.register_schema(kind, 'ros2msg', b''))
            for topic, kind in TOPICS.items()}
        for run in range(max(1, round(minutes * 60e9 / length))):
            for topic, stamp, data in messages:
                later = stamp + run * length
                header = struct.pack('<iI', *divmod(later, 1_000_000_000))
                writer.add_message(channels[topic], later, data[:4] + header + data[12:], later)
        writer.finish()


def one_run() -> list[tuple[str, int, bytes]]:
    """Return topic, stamp and message of a robot that goes to 18 stations once."""
    base = SCENARIOS['plate']
    robot = replace(base.robot, rate=POSES, dwell=2.0, move=1.0)
    made = simulate(replace(base, robot=robot, sensor=replace(base.sensor, rate=PROFILES)),
                    np.random.default_rng(0))
    topics = {Profile: '/profile', TimedPose: '/flange_pose'}
    return [(topics[type(item)], item.stamp, serialised(item, LAYOUTS['xyz'], 'm'))
            for item in sorted([*made.profiles, *made.poses], key=lambda item: item.stamp)]


def bare(path: Path, deserialise: bool) -> None:
    """Go through a bag with rosbags alone."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([path], default_typestore=store) as reader:
        for connection, _, data in reader.messages():
            if deserialise:
                store.deserialize_cdr(data, connection.msgtype)


def least_seconds(works: Sequence[Callable[[], object]], rounds: int = 9) -> list[float]:
    """Return the least processor time of each work, done in turn: others may be busy, too."""
    least = [float('inf')] * len(works)
    for _ in range(rounds):
        for number, work in enumerate(works):
            start = time.process_time()
            work()
            least[number] = min(least[number], time.process_time() - start)
    return least


def tell_rates(path: Path, minutes: float, config: Config) -> None:
    """Print how fast a bag is read."""
    raw, full, ours = least_seconds([lambda: bare(path, False), lambda: bare(path, True),
                                     lambda: bag.read(path, config)])
    print(f'{minutes:g} min, {path.stat().st_size / 1e6:.0f} MB: rosbags {raw:.2f} s, and '
          f'deserialised {full:.2f} s; bag.read {ours:.2f} s: {raw / ours:.0%} and '
          f'{full / ours:.0%} of their rates', flush=True)


def solved(path: Path, folder: str) -> tuple[float, float]:
    """Return the CPU time (s, of all so far) and the peak memory (MB) of `handeye solve`."""
    code = ('from handeye_ros.cli import main\n'
            'try:\n    main()\nfinally:\n'
            '    status = open("/proc/self/status").read()\n'
            '    print("peak", status.split("VmHWM:")[1].split()[0])')
    run = subprocess.run([sys.executable, '-c', code, 'solve', path, '--config', CONFIG, '--out',
                          folder], check=True, capture_output=True, text=True)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime, int(run.stdout.split('peak')[-1]) / 1024


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--minutes', type=float, nargs='+', default=[1.0, 10.0])
    parser.add_argument('--no-solve', action='store_true', help='leave out the solves')
    options = parser.parse_args()
    config, cpu = load(CONFIG, Config()), 0.0
    with tempfile.TemporaryDirectory() as folder:
        for number, minutes in enumerate(sorted(options.minutes)):
            path = Path(folder) / 'bag.mcap'
            make(path, minutes)
            size = path.stat().st_size / 1e6
            if number == 0:
                tell_rates(path, minutes, config)
            if not options.no_solve:
                before = cpu
                cpu, memory = solved(path, folder)
                print(f'handeye solve, {minutes:g} min, {size:.0f} MB: {cpu - before:.1f} s, peak '
                      f'{memory:.0f} MB', flush=True)


if __name__ == '__main__':
    main()
