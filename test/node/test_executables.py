# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The executables beside the node, each in a process of its own, heard over real topics."""
from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from itertools import count, islice
from pathlib import Path
import signal
import subprocess
import sys

import pytest
from quick import long_run

pytest.importorskip('rclpy', reason='needs rclpy')
from command import PATIENCE, PLATE, ROOT, run_python, running  # noqa: E402, I100
from geometry_msgs.msg import PoseStamped  # noqa: E402
from handeye_ros import se3  # noqa: E402
from handeye_ros.arm import arm_of  # noqa: E402
from handeye_ros.bags.storage import RecordedMessage  # noqa: E402
from handeye_ros.errors import InputError  # noqa: E402
from handeye_ros.node.executables import ros, run_for_exit_code  # noqa: E402
from handeye_ros.results.calibration_file import write_calibration  # noqa: E402
from handeye_ros.simulate import robot  # noqa: E402
from moving_scan import (  # noqa: E402
    calibration,
    moving,
    plane_profile,
    plane_profiles,
    pose_at,
    STEP,
    T0,
)
import numpy as np  # noqa: E402
from rclpy.serialization import deserialize_message  # noqa: E402
from recordings import rewrite, scan  # noqa: E402
from ros_clouds import cloud  # noqa: E402
from ros_helpers import (  # noqa: E402
    BEST_EFFORT,
    Client,
    cloud_message,
    LATCHED,
    pose_message,
    RELIABLE,
    run_module,
    XZ,
)
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import JointState, PointCloud2  # noqa: E402

pytestmark = pytest.mark.ros

BAG = ROOT / 'bags' / 'one_orientation'
Q = [0.1, -0.2, 0.3, 0.4, 0.5, -0.6]


def started(module: str, *arguments: object) -> AbstractContextManager[subprocess.Popen[str]]:
    return running([sys.executable, '-m', f'handeye_ros.node.{module}', *map(str, arguments)],
                   cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


@pytest.mark.parametrize(('module', 'arguments', 'reason'), [
    ('calibrate', ['config/plate.yaml'], 'unrecognized arguments: config/plate.yaml'),
    *long_run(
        ('replay', ['no/such/bag'], 'no/such/bag: no such file or folder'),
        ('calibrate', ['--ros-args', '-p', 'output_dir:=/proc/x'],
         'cannot write /proc/x (output_dir)'),
        ('calibrate', ['--ros-args', '-p', 'output_dir:=/proc'],
         'cannot write /proc (output_dir)'),
        ('scan', ['none.yaml'], 'none.yaml cannot be used'),
        ('calibrate', ['--ros-args', '-p', 'profile_topic:=my profile'], '"my profile" cannot '),
        ('calibrate', ['--ros-args', '-p', 'target.size:=[1.0, 2]'], 'ROS does not start: '),
        ('calibrate', ['--ros-args', 'nonsense'], 'ROS does not start: '))])
def test_wrong_arguments_are_refused(module: str, arguments: list[str], reason: str) -> None:
    run = run_module(module, *arguments)
    assert run.returncode == 2 and f'error: {reason}' in run.stderr
    assert 'Traceback' not in run.stderr


def test_what_the_system_refuses_is_a_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_for_exit_code(Path('/no/such/file').read_text) == InputError.exit_code
    assert capsys.readouterr().err.startswith('error: [Errno 2] No such file or directory')


def test_a_service_without_a_home_is_told_what_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ('ROS_LOG_DIR', 'ROS_HOME', 'HOME'):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError, match='no place for its logs.*set one of them'), ros():
        pass


@pytest.mark.thorough
def test_the_demo_of_the_readme_ends_with_the_answer_and_its_report(tmp_path: Path) -> None:
    run = run_python(ROOT / 'tools/demo.py', '--bag', ROOT / 'bags/plate', '--config', PLATE,
                     '--out', tmp_path, '--rate', 8, cwd=tmp_path, timeout=PATIENCE)
    assert run.returncode == 0, run.stderr
    assert 'error against truth.yaml: translation 0.0' in run.stdout
    assert {'calibration.yaml', 'report.html'} <= {path.name for path in tmp_path.iterdir()}


# -- replay


def test_every_message_of_a_bag_arrives_as_it_was_recorded(tmp_path, client: Client) -> None:
    _, recorded = scan(BAG)
    old_clock = RecordedMessage(
        '/clock', 'rosgraph_msgs/msg/Clock', recorded[9].log_time, bytes(12))
    bag = rewrite(BAG, tmp_path / 'with_clock.mcap', [*recorded, old_clock],
                  {'/clock': old_clock.message_type})
    types = {'/profile': PointCloud2, '/flange_pose': PoseStamped}
    received: dict[str, list[object]] = {topic: [] for topic in types}
    for topic, kind in types.items():
        client.node.create_subscription(kind, topic, received[topic].append, RELIABLE)
    clock: list[Clock] = []
    client.node.create_subscription(Clock, '/clock', clock.append, RELIABLE)
    with started('replay', bag, '--rate', 20) as replay:
        client.until(lambda: replay.poll() is not None, 'the replay ends')
        client.until(lambda: sum(map(len, received.values())) == len(recorded), 'all is heard')
        assert (replay.returncode, replay.communicate()) == (0, ('', ''))
    for topic, messages in received.items():
        assert messages == [deserialize_message(raw.data, types[topic])
                            for raw in recorded if raw.topic == topic]
    times = [msg.clock.sec * 10**9 + msg.clock.nanosec for msg in clock]
    assert times == sorted(times) and times[-1] == max(raw.log_time for raw in recorded)


@pytest.mark.thorough
def test_without_subscribers_it_says_so_and_interrupted_it_ends_cleanly(client: Client) -> None:
    poses: list[object] = []
    client.node.create_subscription(PoseStamped, '/flange_pose', poses.append, RELIABLE)
    with started('replay', BAG, '--timeout', 1) as replay:
        client.until(lambda: poses, 'the replay has begun')
        replay.terminate()
        _, stderr = replay.communicate(timeout=PATIENCE)
        assert stderr.startswith('no subscriber on /profile') and replay.returncode == 0


# -- publish


def test_saved_calibrations_are_heard_by_who_comes_late(tmp_path: Path, client: Client) -> None:
    TFMessage = pytest.importorskip('tf2_msgs.msg', reason='needs tf2_msgs').TFMessage
    laser = replace(calibration(), parent_frame='flange', child_frame='laser')
    camera = replace(laser, child_frame='camera', parent_frame='base',
                     T_flange_sensor=se3.inverse(laser.T_flange_sensor))
    for saved in (laser, camera):
        (tmp_path / saved.child_frame).mkdir()
        write_calibration(saved, tmp_path / saved.child_frame / 'calibration.yaml')
    messages: list[TFMessage] = []
    with started('publish', tmp_path / 'laser', tmp_path / 'camera' / 'calibration.yaml') as node:
        client.node.create_subscription(TFMessage, '/tf_static', messages.append, LATCHED)
        client.until(lambda: messages, 'the transforms are published')
        node.send_signal(signal.SIGINT)
        assert node.wait(PATIENCE) == 0
    result = {(t.header.frame_id, t.child_frame_id): t.transform for t in messages[0].transforms}
    assert result.keys() == {('flange', 'laser'), ('base', 'camera')}
    for saved in (laser, camera):
        t = result[saved.parent_frame, saved.child_frame]
        T = se3.from_quaternion(np.array([getattr(t.translation, k) for k in 'xyz']),
                                np.array([getattr(t.rotation, k) for k in 'xyzw']))
        np.testing.assert_allclose(T, saved.T_flange_sensor, rtol=0, atol=1e-12)
    for other, reason in (('none', 'none cannot be used'), ('laser', 'name each sensor once')):
        run = run_module('publish', str(tmp_path / 'laser'), str(tmp_path / other))
        assert run.returncode == 2 and reason in run.stderr


# -- scan


def of_points(points: np.ndarray, stamp: int, height: int = 1) -> PointCloud2:
    columns = dict(zip('xz', points.T, strict=True))
    return cloud_message(cloud(columns, XZ, 8, height=height), stamp)


@contextmanager
def scanning(folder: Path, client: Client, *arguments: str) -> Iterator[list[PointCloud2]]:
    """Give what a scan with the calibration of moving_scan publishes."""
    write_calibration(calibration(), folder / 'calibration.yaml')
    clouds: list[PointCloud2] = []
    client.node.create_subscription(PointCloud2, '/handeye_scan/points', clouds.append, 100)
    with started('scan', folder, *arguments):
        client.until_heard()
        client.until(lambda: client.node.count_publishers('/handeye_scan/points'), 'it is there')
        yield clouds


def heights(clouds: list[PointCloud2]) -> np.ndarray:
    """Return z of all points; all fields are of four bytes."""
    return np.concatenate([np.frombuffer(bytes(c.data), np.float32).reshape(
        -1, len(c.fields))[:, 2] for c in clouds])


def test_scanned_points_are_published_in_the_base(tmp_path: Path, client: Client) -> None:
    with scanning(tmp_path, client, '--std', '--range', '-inf', '-100mm', '--set',
                  'profile.period=0.001') as clouds:
        poses, profiles = iter(moving(10_000)), iter(plane_profiles(10_000))

        def most_points_came() -> bool:
            # who takes best effort hears what is sent after it knows of the sender
            client.send(client.poses, (pose_message(p.stamp, p.translation, p.quaternion)
                                       for p in islice(poses, 1)), 200.0)
            batch = [*islice(profiles, 5)]  # a row each, with the stamp of the first
            points = np.concatenate([profile.points for profile in batch])
            client.send(client.profiles, [of_points(points, batch[0].stamp, height=5)], 200.0)
            return sum(c.width for c in clouds) >= 50 * 50

        client.until(most_points_came, 'most points came')
    assert {c.header.frame_id for c in clouds} == {'base'}
    assert [f.name for f in clouds[0].fields] == ['x', 'y', 'z', 'std']
    np.testing.assert_allclose(heights(clouds), 0.1, atol=1e-6)


@pytest.mark.thorough
def test_profiles_before_a_clock_reset_are_not_scanned(tmp_path: Path, client: Client) -> None:
    def send(ms: int) -> None:
        pose, profile = pose_at(ms), plane_profile(ms)
        client.send(client.poses, [pose_message(pose.stamp, pose.translation, pose.quaternion)],
                    200.0)
        client.send(client.profiles, [of_points(profile.points, profile.stamp)], 200.0)

    with scanning(tmp_path, client) as clouds:
        place = count(10_000)

        def came() -> bool:
            send(next(place))
            return bool(clouds)

        client.until(came, 'it hears both')
        waiting = of_points(plane_profile(0).points + [0, 1], T0 + 12_000 * STEP)
        client.send(client.profiles, [waiting] * 5, 200.0)  # no pose comes after it
        for ms in range(5_000, 5_100):
            send(ms)
        clouds.clear()
        for ms in range(11_950, 12_050):
            send(ms)
        client.until(lambda: clouds, 'the scan goes on')
    np.testing.assert_allclose(heights(clouds), 0.1, atol=1e-4)


@pytest.mark.thorough
def test_a_scan_tells_why_it_hears_nothing(tmp_path: Path, client: Client) -> None:
    write_calibration(calibration(), tmp_path / 'calibration.yaml')
    with started('scan', tmp_path, '--set', 'profile_topic=/laser') as node:
        told = next(line for line in node.stderr if 'is on /profile: set profile_topic' in line)
    assert 'no profiles on /laser for ' in told and '/laser has no publisher; ' in told


# -- corrected_pose


def test_a_corrected_pose_follows_every_joint_state(tmp_path: Path, client: Client) -> None:
    pytest.importorskip('pinocchio', reason='needs pinocchio')
    urdf = robot.URDF.replace('0 0 0.75', '0.002 0 0.75')
    (tmp_path / 'arm.urdf').write_text(urdf)
    poses: dict[bool, PoseStamped] = {}  # by whether they have the stamp of the joint values
    client.node.create_subscription(PoseStamped, '/corrected_pose', lambda msg: poses.update(
        {msg.header.stamp.sec == 7: msg}), BEST_EFFORT)
    joints = client.node.create_publisher(JointState, '/joint_states', BEST_EFFORT)
    state = JointState(name=[f'joint_{k}' for k in range(6, 0, -1)], position=Q[::-1])
    state.header.stamp.sec = 7

    def heard() -> bool:
        joints.publish(JointState(name=['gripper'], position=[0.0]))
        joints.publish(state)
        joints.publish(JointState(name=state.name, position=state.position))
        return len(poses) == 2
    with started('corrected_pose', '--urdf', tmp_path / 'arm.urdf'):
        client.until(heard, 'a pose comes')
    T = arm_of(urdf).forward(np.array([Q]))[0]
    p = poses[True].pose.position
    np.testing.assert_allclose([p.x, p.y, p.z], T[:3, 3], atol=1e-12)
    assert poses[True].header.frame_id == 'base' and poses[False].header.stamp.sec > 10**9
