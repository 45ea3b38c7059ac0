#!/usr/bin/env python3
"""
Malformed messages and damaged files: no crash, no hang, no memory without bound.

usage: python bench/fuzz.py [--messages 1000000] [--files 100000] [--seconds S] [--seed 0]
       python bench/fuzz.py --guided [--seconds S]

Each case is made by its number and the seed alone, so a failure is found again. It must end in
an answer that holds what its type promises or in an error of this package, within 2 s, and the
process must stay below 1 GB. Prints for each kind the counts, how many were refused, and the
slowest. --guided: atheris leads the bytes of messages and mcap files by coverage (needs atheris).
"""
from __future__ import annotations

import argparse
from collections.abc import Callable
import contextlib
import inspect
import io
from pathlib import Path
import resource
import shutil
import struct
import sys
import tempfile
import time
from types import SimpleNamespace
from typing import Any

from handeye_ros.config import Config, load, ProfileConfig
from handeye_ros.data import Profile, TimedPose
from handeye_ros.errors import HandeyeError
from handeye_ros.files.tables import Table
from handeye_ros.results.calibration_file import read_calibration
from handeye_ros.results.truth_file import true_transform
from handeye_ros.ros.bags import bag, bag_write, cdr, flow
from handeye_ros.ros.bags.batches import split
from handeye_ros.ros.bags.contents import Raw
from handeye_ros.ros.bags.messages import pose_from_cdr, returns_from_cloud
from handeye_ros.ros.bags.profile_reader import ProfileReader
from handeye_ros.ros.bags.transforms import FlangeTracker
from handeye_ros.ros.bags.tree import Transforms
from handeye_ros.ros.sessions.reading import is_session, read_session
from handeye_ros.sampling.session import Session
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

ROOT = Path(__file__).parents[1]
SLOWEST = 2.0  # s
LARGEST = 1024.0  # MB
STORE = get_typestore(Stores.ROS2_JAZZY)
SIZES = (0, 1, 2, 7, 12, 60, 2 ** 8, 2 ** 16, 2 ** 31 - 1, 2 ** 31, 2 ** 32 - 12, 2 ** 32 - 1)
HOSTILE = (b'1e999', b'nan', b'-.inf', b'[' * 2000, b'{' * 500, b'&a [*a]', b'9' * 400, b'\x00',
           b'!!python/object/apply:os.system [id]', b'\xff\xfe', b'- ' * 300, b': ', b'~', b'"',
           b'\n\n', b'true', b'0x7fffffffffffffffff', b'2026-13-45', b'\xc3', b'<<: *b')
FRAMES = ('base', 'flange', 'a', 'b', 'c', '', '/base', 'x' * 300)
Case = Callable[[np.random.Generator, Path], None]


def size(rng: np.random.Generator) -> int:
    """Return a number that a size may be, or must not."""
    return int(rng.choice(SIZES)) if rng.random() < 0.7 else int(rng.integers(0, 2 ** 32))


def damaged(data: bytes, rng: np.random.Generator, text: bool = False) -> bytes:
    """Return bytes with some overwritten, cut, doubled or put in."""
    found = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(0, len(found) + 1))
        length = int(rng.integers(1, 40))
        kind = int(rng.integers(0, 6))
        if kind == 0:
            found[at:at + length] = rng.bytes(length)
        elif kind == 1:
            del found[at:]
        elif kind == 2:
            del found[at:at + length]
        elif kind == 3:
            found[at:at] = found[at:at + length]
        elif kind == 4 or not text:
            found[at:at + 8] = struct.pack('<Q', int(rng.choice(np.array(SIZES, np.uint64))))
        else:
            found[at:at] = HOSTILE[int(rng.integers(0, len(HOSTILE)))]
    return bytes(found)


def any_cloud(rng: np.random.Generator) -> bytes:
    """Return a PointCloud2 every field of which is random, as it is serialised."""
    def text(value: bytes) -> bytes:
        return struct.pack('<I', len(value) + 1) + value + b'\0' + b'\0' * (-(len(value) + 1) % 4)

    count = int(rng.integers(0, 6))
    names = [b'x', b'y', b'z', b'intensity', b'', b'\xff', b'long' * 20]
    body = struct.pack('<iI', int(rng.integers(-2 ** 31, 2 ** 31)), size(rng))
    body += text([b'laser', b'', b'/a', b'\xc3\x28'][int(rng.integers(0, 4))])
    body += struct.pack('<III', size(rng), size(rng), count)
    for _ in range(count):
        body += text(names[int(rng.integers(0, len(names)))])
        body += struct.pack('<IB3xI', size(rng), int(rng.integers(0, 12)), size(rng))
    data = rng.bytes(int(rng.integers(0, 400)))
    claimed = len(data) if rng.random() < 0.8 else size(rng)
    body += struct.pack('<B3xIII', int(rng.integers(0, 3)), size(rng), size(rng), claimed)
    return b'\0\1\0\0' + body + data + b'\1'


X = np.linspace(-0.02, 0.02, 40)
GOOD_CLOUD = bag_write.serialised(Profile(10 ** 18, 'laser', np.column_stack([X, 0.2 + X])),
                                  bag_write.LAYOUTS['scancontrol'], 'm')
GOOD_POSE = bag_write.serialised(
    TimedPose(10 ** 18, np.ones(3), np.array([0, 0.6, 0, 0.8])), bag_write.LAYOUTS['xyz'], 'm')
CONFIGS = tuple(ProfileConfig(unit=unit, rows=rows, period=period, axes=axes)
                for unit in ('m', 'mm') for rows in ('auto', 'points', 'profiles')
                for period in (0.0, 1e-3) for axes in (('x', 'z'), ('-y', 'z')))


def cloud_case(rng: np.random.Generator, folder: Path) -> None:
    """Read a cloud."""
    kind = rng.random()
    data = (any_cloud(rng) if kind < 0.5 else damaged(GOOD_CLOUD, rng) if kind < 0.9 else
            GOOD_CLOUD[:int(rng.integers(0, len(GOOD_CLOUD)))])
    check_cloud(data, CONFIGS[int(rng.integers(0, len(CONFIGS)))])


def check_cloud(data: bytes, config: ProfileConfig) -> None:
    """Read a cloud in all ways; what comes out are points within reach, or none."""
    reader = ProfileReader(config)
    reader.take(GOOD_CLOUD) if config.unit == 'm' and config.axes == ('x', 'z') else None
    with contextlib.suppress(HandeyeError):
        raw = reader.take(data)
        for one in split(raw, raw.stamp - 1000, config)[:3]:
            points = one.read().points
            lost = np.isnan(points).any(axis=1)
            assert points.ndim == 2 and points.shape[1] == 2
            assert (np.abs(points[~lost]) <= 10.0).all()
    returns_from_cloud(cdr.cloud(data), config)


def pose_case(rng: np.random.Generator, folder: Path) -> None:
    """Read a pose."""
    data = damaged(GOOD_POSE, rng) if rng.random() < 0.5 else (
        GOOD_POSE[:-56] + rng.bytes(56))
    pose = pose_from_cdr(data)
    assert np.isfinite(pose.translation).all()
    assert abs(np.linalg.norm(pose.quaternion) - 1.0) < 1e-9


def tf_case(rng: np.random.Generator, folder: Path) -> None:
    """Put transforms with loops and cycles together."""
    tracker = FlangeTracker('base', 'flange')
    for _ in range(int(rng.integers(1, 12))):
        numbers = rng.normal(size=7) * rng.choice([1.0, 1e200, np.nan], p=[0.9, 0.05, 0.05])
        numbers[3:] /= np.linalg.norm(numbers[3:])
        msg = SimpleNamespace(
            header=SimpleNamespace(stamp=any_stamp(rng), frame_id=str(rng.choice(FRAMES))),
            child_frame_id=str(rng.choice(FRAMES)), transform=SimpleNamespace(
                translation=SimpleNamespace(**dict(zip('xyz', numbers[:3], strict=True))),
                rotation=SimpleNamespace(**dict(zip('xyzw', numbers[3:], strict=True)))))
        with contextlib.suppress(HandeyeError):
            for pose in tracker.add([msg], static=bool(rng.random() < 0.3)):
                assert np.isfinite(pose.translation).all()
    tracker.missing()
    Transforms().take(damaged(GOOD_POSE, rng))


def any_stamp(rng: np.random.Generator) -> int:
    """Return a stamp from 0 to 2^63."""
    near = 10 ** 18 + int(rng.integers(0, 5 * 10 ** 9))
    return near if rng.random() < 0.8 else int(rng.integers(0, 2 ** 63 - 1))


def stamps_case(rng: np.random.Generator, folder: Path) -> None:
    """Give a session messages whose stamps are anything."""
    session = Session(Config())
    stamp = 10 ** 18
    for _ in range(60):
        stamp += 20_000_000
        at = stamp if rng.random() < 0.8 else any_stamp(rng)
        if rng.random() < 0.6:
            session.add_pose(TimedPose(at, np.zeros(3), np.array([0, 0, 0, 1.0])))
        else:
            session.add_profile(Profile(at, 'laser', np.column_stack([X, 0.2 + X])))
        session.collect()
    session.finish()
    session.require_stations()


def bag_case(name: str) -> Case:
    """Return a case that reads a damaged recording, and scans it."""
    def case(rng: np.random.Generator, folder: Path) -> None:
        good = folder / 'good' / name
        file = folder / f'damaged{good.suffix}'
        file.write_bytes(damaged(good.read_bytes(), rng))
        with contextlib.suppress(HandeyeError):
            recording = bag.read(file, Config())
            assert recording.profiles and len(recording.poses)
            for profile in recording.profiles[:3]:
                with contextlib.suppress(HandeyeError):
                    profile.read()
        for _ in zip(flow.flow(file, Config()).profiles(), range(3), strict=False):
            pass
    return case


def metadata_case(rng: np.random.Generator, folder: Path) -> None:
    """Read a bag whose metadata.yaml is damaged."""
    text = (folder / 'good' / 'bag' / 'metadata.yaml').read_bytes()
    (folder / 'bag' / 'metadata.yaml').write_bytes(damaged(text, rng, text=True))
    assert bag.read(folder / 'bag', Config()).profiles


def text_case(name: str, read: Callable[[Path], Any]) -> Case:
    """Return a case that reads a damaged text file."""
    def case(rng: np.random.Generator, folder: Path) -> None:
        good = folder / 'good' / name
        file = folder / f'damaged{good.suffix}'
        file.write_bytes(damaged(good.read_bytes(), rng, text=True))
        read(file)
    return case


def check_calibration(file: Path) -> None:
    """Read a calibration; what comes out is a transform."""
    found = read_calibration(file)
    R = found.T_flange_sensor[:3, :3]
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-6) and np.linalg.det(R) > 0
    assert np.isfinite(found.T_flange_sensor).all() and np.isfinite(found.covariance).all()


def session_case(rng: np.random.Generator, folder: Path) -> None:
    """Read a session one file of which is damaged."""
    target = folder / 'session'
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(folder / 'good' / 'session', target)
    files = sorted(target.iterdir())
    file = files[int(rng.integers(0, len(files)))]
    file.write_bytes(damaged(file.read_bytes(), rng, text=file.suffix == '.yaml'))
    is_session(target)
    read_session(target).session(Config())


MESSAGES: dict[str, Case] = {'PointCloud2': cloud_case, 'PoseStamped': pose_case,
                             'transforms': tf_case, 'stamps': stamps_case}
FILES: dict[str, Case] = {
    'mcap': bag_case('small.mcap'), 'mcap, zstd': bag_case('zstd.mcap'),
    'db3': bag_case('small.db3'),
    'metadata.yaml': metadata_case,
    'calibration.yaml': text_case('calibration.yaml', check_calibration),
    'truth.yaml': text_case('truth.yaml', lambda file: true_transform(file.parent)),
    'CSV': text_case('tracker.csv', Table), 'config YAML': text_case('plate.yaml', load),
    'session': session_case}
SHARES = {'PointCloud2': 0.6, 'PoseStamped': 0.37, 'transforms': 0.02, 'stamps': 0.01}


def prepare(folder: Path) -> None:
    """Write what is to be damaged."""
    good = folder / 'good'
    good.mkdir()
    profiles = [Profile(10 ** 18 + i * 33_000_000, 'laser', np.column_stack([X, 0.2 + X]))
                for i in range(8)]
    poses = [TimedPose(10 ** 18 + i * 20_000_000, np.zeros(3), np.array([0, 0, 0, 1.0]))
             for i in range(16)]
    bag_write.write(good / 'bag', profiles, poses)
    shutil.copytree(good / 'bag', folder / 'bag')
    shutil.copy(good / 'bag' / 'bag.mcap', good / 'zstd.mcap')
    raws = [Raw('/profile', p.stamp, bag_write.serialised(p, bag_write.LAYOUTS['xyz'], 'm'))
            for p in profiles] + [
        Raw('/flange_pose', p.stamp, bag_write.serialised(p, bag_write.LAYOUTS['xyz'], 'm'))
        for p in poses]
    write_database(good, raws)
    write_plain(good / 'small.mcap', raws)
    write_session(good, folder)
    shutil.copy(ROOT / 'config' / 'plate.yaml', good)
    shutil.copy(ROOT / 'bags' / 'plate' / 'truth.yaml', good)
    shutil.copy(ROOT / 'bags' / 'tracker' / 'tracker.csv', good)


def write_database(good: Path, raws: list[Raw]) -> None:
    """Write small.db3."""
    with Writer(good / 'database', version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        kinds = {'/profile': 'sensor_msgs/msg/PointCloud2',
                 '/flange_pose': 'geometry_msgs/msg/PoseStamped'}
        topics = {t: writer.add_connection(t, kind, typestore=STORE) for t, kind in kinds.items()}
        for raw in raws:
            writer.write(topics[raw.topic], raw.log_time, raw.data)
    shutil.copy(good / 'database' / 'database.db3', good / 'small.db3')


def write_plain(path: Path, raws: list[Raw]) -> None:
    """Write an .mcap file of several chunks, not packed."""
    from mcap.writer import CompressionType
    from mcap.writer import Writer as McapWriter
    with path.open('wb') as stream:
        writer = McapWriter(stream, chunk_size=4096, compression=CompressionType.NONE)
        writer.start('ros2')
        topics = {t: writer.register_channel(t, 'cdr', writer.register_schema(
            kind, 'ros2msg', b'')) for t, kind in (
                ('/profile', 'sensor_msgs/msg/PointCloud2'),
                ('/flange_pose', 'geometry_msgs/msg/PoseStamped'))}
        for raw in raws:
            writer.add_message(topics[raw.topic], raw.log_time, raw.data, raw.log_time)
        writer.finish()


def write_session(good: Path, folder: Path) -> None:
    """Write a session of the bag of a sphere, and calibration.yaml."""
    from handeye_ros import pipeline
    from handeye_ros.results.calibration_file import write_calibration
    from handeye_ros.ros.sessions.writing import SessionStore
    config = load(ROOT / 'config' / 'sphere.yaml')
    recording = bag.read(ROOT / 'bags' / 'sphere', config)
    session = pipeline.gather(recording.profiles, recording.poses, config)
    calibration = pipeline.solve(session.samples, session.rejects, config, session.frame_id)
    write_calibration(calibration, good / 'calibration.yaml')
    (folder / 'sessions').mkdir()
    store = SessionStore(lambda _: folder / 'sessions')
    for outcome in session.outcomes[:2]:
        store.add(outcome, config)
    store.close()
    shutil.copytree(store.path, good / 'session')


def attempt(case: Case, seed: int, number: int, folder: Path) -> tuple[bool, float]:
    """Return whether a case was refused, and its seconds; raises what is no refusal."""
    begin = time.process_time()
    try:
        case(np.random.default_rng([seed, number]), folder)
        refused = False
    except HandeyeError as error:
        refused = bool(str(error))
        assert refused
    return refused, time.process_time() - begin


def fuzz(name: str, case: Case, seed: int, count: int, seconds: float, folder: Path) -> int:
    """Run cases and tell of them; return how many failed."""
    refused, slowest, failed, done = 0, 0.0, 0, 0
    end = time.process_time() + seconds
    while done < count and time.process_time() < end:
        try:
            no, took = attempt(case, seed, done, folder)
            refused += no
            slowest = max(slowest, took)
            assert took < SLOWEST, f'it took {took:.1f} s'
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            failed += 1
            if failed <= 5:
                print(f'FAILED {name}, seed {seed}, number {done}: {error!r}', flush=True)
        done += 1
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f'{name:17} seed {seed}: {done:8} cases, {refused:8} refused, {failed} failed; slowest '
          f'{slowest:.3f} s, {memory:.0f} MB', flush=True)
    return failed + (memory > LARGEST)


def read_functions() -> list[Any]:
    """Return the functions and methods of what reads messages and bags."""
    modules = [m for name, m in sys.modules.items() if name.startswith('handeye_ros.ros.bags.')]
    classes = [c for module in modules for c in vars(module).values()
               if inspect.isclass(c) and c.__module__ == module.__name__]
    return [function for owner in (*modules, *classes) for function in vars(owner).values()
            if inspect.isfunction(function) and function.__module__.startswith('handeye_ros.ros.')]


def guided(seconds: float) -> None:
    """Let atheris lead the bytes; it ends the process at the first failure."""
    import atheris
    for function in read_functions():
        atheris.instrument_func(function)
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / 'x.mcap'

        def one(data: bytes) -> None:
            with contextlib.suppress(HandeyeError):
                pose_from_cdr(data)
            with contextlib.suppress(HandeyeError):
                check_cloud(data, CONFIGS[len(data) % len(CONFIGS)])
            with contextlib.suppress(HandeyeError), contextlib.redirect_stderr(io.StringIO()):
                file.write_bytes(b'\x89MCAP0\r\n' + data)
                bag.read(file, Config())

        corpus = Path(name) / 'corpus'
        corpus.mkdir()
        for number, seed in enumerate((GOOD_CLOUD, GOOD_POSE)):
            (corpus / str(number)).write_bytes(seed)
        atheris.Setup([sys.argv[0], f'-max_total_time={seconds:.0f}', '-timeout=2',
                       '-rss_limit_mb=1024', str(corpus)], one)
        atheris.Fuzz()


def main() -> int:
    """Run all kinds; the exit code is 1 where one failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--messages', type=int, default=1_000_000)
    parser.add_argument('--files', type=int, default=100_000)
    parser.add_argument('--seconds', type=float, default=3600.0, help='of each kind, at most')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--guided', action='store_true')
    options = parser.parse_args()
    if options.guided:
        guided(options.seconds)
        return 0
    failed = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare(folder)
        for kind, case in MESSAGES.items():
            failed += fuzz(kind, case, options.seed, round(options.messages * SHARES[kind]),
                           options.seconds, folder)
        for kind, case in FILES.items():
            failed += fuzz(kind, case, options.seed, options.files // len(FILES),
                           options.seconds, folder)
    return bool(failed)


if __name__ == '__main__':
    sys.exit(main())
