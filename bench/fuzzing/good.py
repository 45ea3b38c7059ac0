"""What is to be damaged: small files of every kind, all good."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import shutil

from fuzzing.messages import X
from handeye_ros import pipeline
from handeye_ros.bags import bag, bag_write
from handeye_ros.bags.contents import CLOUD, POSE, Raw
from handeye_ros.bags.session_writing import SessionStore
from handeye_ros.config import Config, load
from handeye_ros.data import Profile, TimedPose
from handeye_ros.results.calibration_file import write_calibration
from handeye_ros.sampling.stops import Stop
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

ROOT = Path(__file__).parents[2]
STORE = get_typestore(Stores.ROS2_JAZZY)
SHORT = 3  # profiles of a stop
KINDS = {'/profile': CLOUD, '/flange_pose': POSE}


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
    write_session(good)
    shutil.copytree(good / 'session', folder / 'session')
    shutil.copy(ROOT / 'config' / 'plate.yaml', good)
    shutil.copy(ROOT / 'bags' / 'plate' / 'truth.yaml', good)
    shutil.copy(ROOT / 'bags' / 'tracker' / 'tracker.csv', good)


def write_database(good: Path, raws: list[Raw]) -> None:
    """Write small.db3."""
    with Writer(good / 'database', version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topics = {t: writer.add_connection(t, kind, typestore=STORE) for t, kind in KINDS.items()}
        for raw in raws:
            writer.write(topics[raw.topic], raw.log_time, raw.data)
    shutil.copy(good / 'database' / 'database.db3', good / 'small.db3')


def write_plain(path: Path, raws: list[Raw]) -> None:
    """Write an .mcap file of several chunks, not packed."""
    with path.open('wb') as stream:
        writer = McapWriter(stream, chunk_size=4096, compression=CompressionType.NONE)
        writer.start('ros2')
        topics = {t: writer.register_channel(t, 'cdr', writer.register_schema(
            kind, 'ros2msg', b'')) for t, kind in KINDS.items()}
        for raw in raws:
            writer.add_message(topics[raw.topic], raw.log_time, raw.data, raw.log_time)
        writer.finish()


def write_session(good: Path) -> None:
    """Write a session of two short stops of the bag of a sphere, and calibration.yaml."""
    config = load(ROOT / 'config' / 'sphere.yaml')
    recording = bag.read(ROOT / 'bags' / 'sphere', config)
    session = pipeline.gather(recording.profiles, recording.poses, config)
    calibration = pipeline.solve(session.samples, session.rejects, config, session.frame_id)
    write_calibration(calibration, good / 'calibration.yaml')
    (good / 'sessions').mkdir()
    store = SessionStore(lambda _: good / 'sessions')
    for outcome in session.outcomes[:2]:
        store.add(replace(outcome, stop=shortened(outcome.stop, config)), config)
    store.close()
    shutil.copytree(store.path, good / 'session')


def shortened(stop: Stop, config: Config) -> Stop:
    """Return a stop with a part of its profiles, so that it is read quickly."""
    seen = stop.load(config)
    return replace(stop, load=lambda _: replace(seen, profiles=seen.profiles[:SHORT]))
