"""Malformed messages, and what is asked of those who read them."""
from __future__ import annotations

import contextlib
from pathlib import Path
import struct
from types import SimpleNamespace

from fuzzing.damage import Case, damaged, size
from handeye_ros.bags import bag_write
from handeye_ros.bags.contents import CLOUD
from handeye_ros.bags.messages import deserialised, pose_from_cdr, returns_from_cloud
from handeye_ros.bags.profile_reader import ProfileReader, split
from handeye_ros.bags.transforms import FlangeTracker, Transforms
from handeye_ros.config import Config, ProfileConfig
from handeye_ros.data import Profile, TimedPose
from handeye_ros.errors import HandeyeError
from handeye_ros.sampling.session import Session
import numpy as np

FRAMES = ('base', 'flange', 'a', 'b', 'c', '', '/base', 'x' * 300)
X = np.linspace(-0.02, 0.02, 40)
GOOD_CLOUD = bag_write.serialised(Profile(10 ** 18, 'laser', np.column_stack([X, 0.2 + X])),
                                  bag_write.LAYOUTS['scancontrol'], 'm')
GOOD_POSE = bag_write.serialised(
    TimedPose(10 ** 18, np.ones(3), np.array([0, 0.6, 0, 0.8])), bag_write.LAYOUTS['xyz'], 'm')
CONFIGS = tuple(ProfileConfig(unit=unit, rows=rows, period=period, axes=axes)
                for unit in ('m', 'mm') for rows in ('auto', 'points', 'profiles')
                for period in (0.0, 1e-3) for axes in (('x', 'z'), ('-y', 'z')))


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


def cloud_case(rng: np.random.Generator, folder: Path) -> None:
    """Read a cloud."""
    kind = rng.random()
    data = (any_cloud(rng) if kind < 0.5 else damaged(GOOD_CLOUD, rng) if kind < 0.9 else
            GOOD_CLOUD[:int(rng.integers(0, len(GOOD_CLOUD)))])
    check_cloud(data, CONFIGS[int(rng.integers(0, len(CONFIGS)))])


def check_cloud(data: bytes, config: ProfileConfig) -> None:
    """Read a cloud in all ways; what comes out are points within reach, or none."""
    reader = ProfileReader(config)
    if config.unit == 'm' and config.axes == ('x', 'z'):
        for _ in range(2):  # what is like the last message is read quickly
            reader.take(GOOD_CLOUD)
    with contextlib.suppress(HandeyeError):
        raw = reader.take(data)
        for one in split(raw, raw.stamp - 1000, config)[:3]:
            points = one.read().points
            lost = np.isnan(points).any(axis=1)
            assert points.ndim == 2 and points.shape[1] == 2
            assert (np.abs(points[~lost]) <= 10.0).all()
    returns_from_cloud(deserialised(data, CLOUD), config)


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
            header=SimpleNamespace(stamp=any_time(rng), frame_id=str(rng.choice(FRAMES))),
            child_frame_id=str(rng.choice(FRAMES)), transform=SimpleNamespace(
                translation=SimpleNamespace(**dict(zip('xyz', numbers[:3], strict=True))),
                rotation=SimpleNamespace(**dict(zip('xyzw', numbers[3:], strict=True)))))
        with contextlib.suppress(HandeyeError):
            for pose in tracker.add([msg], static=bool(rng.random() < 0.3)):
                assert np.isfinite(pose.translation).all()
    tracker.missing()
    Transforms().take(damaged(GOOD_POSE, rng))


def any_time(rng: np.random.Generator) -> SimpleNamespace:
    """Return a stamp as it is in a header."""
    sec, nanosec = divmod(any_stamp(rng), 10 ** 9)
    return SimpleNamespace(sec=sec, nanosec=nanosec)


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


MESSAGES: dict[str, Case] = {'PointCloud2': cloud_case, 'PoseStamped': pose_case,
                             'transforms': tf_case, 'stamps': stamps_case}
SHARES = {'PointCloud2': 0.6, 'PoseStamped': 0.37, 'transforms': 0.02, 'stamps': 0.01}
