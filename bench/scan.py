"""
Scanning a bag to a cloud, beside a bare read of the same bag.

usage: .venv/bin/python bench/scan.py [PROFILES]

PROFILES of 1,280 points (default 6000) at 2 kHz and poses at 500 Hz. Tells profiles per second of
a bare rosbags read, of one that also unpacks the messages, and of `handeye scan` to a PLY file,
each in a process of its own, by the clock and by the processor's time; and the largest memory of
that process. 78125 profiles are 10^8 points.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
import multiprocessing
from multiprocessing.connection import Connection
from pathlib import Path
import resource
import sys
import tempfile
import time

from handeye_ros.bags import bag_write
from handeye_ros.bags.bag import flow
from handeye_ros.config import Config
from handeye_ros.data import Calibration, Profile, Quality, TimedPose
from handeye_ros.sampling.trajectory import track_of
from handeye_ros.scanning.cloud_files import cloud_writer
from handeye_ros.scanning.scan import Scanner, ScanOptions
import numpy as np
from rosbags.rosbag2 import Reader
from rosbags.typesys import get_typestore, Stores

COLUMNS, PERIOD = 1280, 500_000  # ns
START = 1_700_000_000_000_000_000


def profiles(count: int, rng: np.random.Generator) -> Iterator[Profile]:
    x = np.linspace(-0.02, 0.02, COLUMNS)
    for k in range(count):
        z = 0.17 + rng.normal(0, 3e-5, COLUMNS)
        yield Profile(START + k * PERIOD, 'laser', np.column_stack([x, z]))


def poses(count: int) -> Iterator[TimedPose]:
    for k in range(count // 4 + 2):
        yield TimedPose(START + (4 * k - 1) * PERIOD, np.array([0.6, 1e-5 * k, 0.4]),
                        np.array([1.0, 0, 0, 0]))


def megabytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def bare(bag: Path, unpack: bool) -> int:
    types = get_typestore(Stores.ROS2_JAZZY)
    count = 0
    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            if unpack:
                types.deserialize_cdr(data, connection.msgtype)
            count += connection.topic == '/profile'
    return count


def scan(bag: Path, out: Path, calibration: Calibration, options: ScanOptions) -> int:
    config = Config()
    source = flow(bag, config)
    scanner, track = Scanner(calibration, config, options), track_of(source.poses, 0.5)
    with cloud_writer(out) as writer:
        for points in scanner.scan(source.profiles(), track):
            writer.write(points)
    assert scanner.count.without_pose == 0
    return scanner.count.profiles


def timed(run: Callable[[], int], result: Connection) -> None:
    """Tell what a run saw, its seconds by the clock and of the processor, and its memory (MB)."""
    start, work = time.perf_counter(), time.process_time()
    seen = run()
    result.send((seen, time.perf_counter() - start, time.process_time() - work, megabytes()))


def apart(run: Callable[[], int]) -> tuple[int, float, float, float]:
    """Return what timed tells, of a process of its own."""
    ours, its = multiprocessing.Pipe()
    fork = multiprocessing.get_context('fork')
    process = fork.Process(target=timed, args=(run, its))
    process.start()
    its.close()
    found = ours.recv()
    process.join()
    return found


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 6000
    quality = Quality(0, 0, 0.0, 0.0, '', 0.0)
    calibration = Calibration('plate', 'plate', 'flange', 'laser', np.eye(4), 1e-10 * np.eye(6),
                              {}, quality, ())

    def written() -> int:
        bag_write.write(bag, profiles(count, np.random.default_rng(0)), poses(count))
        return count

    with tempfile.TemporaryDirectory() as folder:
        bag, out = Path(folder) / 'bag', Path(folder) / 'cloud.ply'
        runs = {'(the bag is written)': written,
                'bare read': lambda: bare(bag, False), 'read and unpack': lambda: bare(bag, True),
                'scan': lambda: scan(bag, out, calibration, ScanOptions()),
                'scan --std --voxel 0.0005': lambda: scan(
                    bag, out, calibration, ScanOptions(voxel=5e-4, std=True))}
        for name, run in runs.items():
            seen, seconds, work, memory = apart(run)
            print(f'{name:26} {seen / seconds:8.0f} profiles/s {seen / work:8.0f} per second of '
                  f'processor, largest memory {memory:6.0f} MB', flush=True)
        print(f'{seen * COLUMNS:.3g} points')


if __name__ == '__main__':
    main()
