# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The node in its own process, over real DDS."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import subprocess
import sys

from handeye_ros.bags.bag import read
from handeye_ros.config import load
from handeye_ros.errors import InputError
from handeye_ros.pipeline import calibrate
from handeye_ros.results.calibration_file import read_calibration
import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from command import PATIENCE  # noqa: E402, I100
from geometry_msgs.msg import PointStamped, PoseStamped, TransformStamped  # noqa: E402
from handeye_ros.bags.session import OutputFolders  # noqa: E402
from handeye_ros.node import params  # noqa: E402
import rclpy  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.node import Node  # noqa: E402
from ros_clouds import cloud  # noqa: E402
from ros_helpers import (  # noqa: E402
    BEST_EFFORT,
    Client,
    cloud_message,
    LATCHED,
    pose_message,
    RELIABLE,
    replay,
    ROOT,
    run_module,
    running_node,
    sphere_profile,
)
from sensor_msgs.msg import PointCloud2  # noqa: E402
from std_msgs.msg import String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from visualization_msgs.msg import MarkerArray  # noqa: E402

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

pytestmark = pytest.mark.ros

needs_tf2 = pytest.mark.skipif(TFMessage is None, reason='tf2_msgs is not built: make tf2_msgs')
PLATE = ROOT / 'config' / 'plate.yaml'
SHARED = ROOT.parent / 'shared' / 'bags' / 'sphere_r40'
needs_shared = pytest.mark.skipif(not SHARED.exists(), reason='sphere_r40 is not there')


@pytest.mark.parametrize(('bag', 'config'), [
    pytest.param(ROOT / 'bags' / 'plate', PLATE, id='plate'),
    pytest.param(SHARED, ROOT / 'config' / 'sphere.yaml', id='sphere_r40', marks=needs_shared),
])
def test_a_bag_through_the_node_gives_the_offline_result(
        tmp_path: Path, client: Client, bag: Path, config: Path) -> None:
    settings = load(config)
    recording = read(bag, settings)
    offline = calibrate(recording.profiles, recording.poses, settings)
    features, markers, texts, poses = [], [], [], []
    client.node.create_subscription(PointCloud2, '/handeye/features', features.append, 100)
    client.node.create_subscription(MarkerArray, '/handeye/markers', markers.append, LATCHED)
    client.node.create_subscription(String, '/handeye/guidance', texts.append, LATCHED)
    client.node.create_subscription(PoseStamped, '/handeye/next_pose', poses.append, LATCHED)
    with running_node(tmp_path, '--params-file', str(config), '-p', 'guidance.accuracy:=1e-5'):
        client.connect()
        client.until(lambda: texts, 'there is advice before the first sample')
        assert texts[0].data.startswith('Take the first sample: ')
        replay(bag)
        client.until_counted(profiles=len(recording.profiles), poses=len(recording.poses),
                             malformed=0)
        answer = client.call('compute_calibration')
        assert answer.success, answer.message
        assert f'{offline.quality.samples_used} samples used' in answer.message
        late: list[TransformStamped] = []
        client.node.create_subscription(TransformStamped, '/handeye/calibration', late.append,
                                        LATCHED)
        client.until(lambda: late, 'the latched calibration comes')
        saved = client.call('save_calibration')
        path = tmp_path / settings.name / 'calibration.yaml'
        assert (saved.success, saved.message) == (True, f'wrote {path}')
        client.until(lambda: markers and len(markers[-1].markers) > 3, 'the target is drawn')
        client.until(lambda: poses, 'a pose is proposed')
        client.until(lambda: 'points in view are known to' in texts[-1].data.lower(),
                     'the words say how well it is known')
        assert client.call('remove_last_sample').success
        n = offline.quality.samples_used + offline.quality.samples_rejected
        again = client.call('save_calibration').message
        assert again.startswith(f'saved already: {path}; ')
        assert again.endswith(
            f'it was computed from {n} samples, which have changed since '
            f'(1 removed): call ~/compute_calibration for an answer from the current {n - 1}')
        assert client.call('clear_samples').success
        client.until(lambda: texts[-1].data.startswith('Take the first sample'),
                     'the advice starts again')
    p, first = poses[-1].pose.position, next(iter(recording.poses)).translation
    assert np.linalg.norm(np.array([p.x, p.y, p.z]) - first) <= settings.guidance.reach + 1e-3
    assert poses[-1].header.frame_id == 'base'
    online = read_calibration(path)
    np.testing.assert_allclose(online.T_flange_sensor, offline.T_flange_sensor, atol=1e-9, rtol=0)
    np.testing.assert_allclose(online.covariance, offline.covariance, rtol=1e-6, atol=1e-15)
    # sums over arrays that went to another process may differ in the last digit
    assert [replace(s, residual=0.0) for s in online.samples] == [
        replace(s, residual=0.0) for s in offline.samples]
    np.testing.assert_allclose([s.residual for s in online.samples if s.used],
                               [s.residual for s in offline.samples if s.used], rtol=1e-9)
    *topics, session = online.provenance['inputs']
    assert topics == [{'topic': '/profile'}, {'topic': '/flange_pose'}]
    assert Path(session['session']).parent == path.parent
    assert len(features) == offline.quality.samples_used + offline.quality.samples_rejected
    assert {f.header.frame_id for f in features} == {'laser'}
    transform = late[0].transform.translation
    assert (late[0].header.frame_id, late[0].child_frame_id) == ('flange', 'laser')
    np.testing.assert_allclose([transform.x, transform.y, transform.z],
                               offline.T_flange_sensor[:3, 3], atol=1e-9)
    assert 'Traceback' not in (tmp_path / 'node.log').read_text()


@needs_tf2
def test_tf_static_for_a_late_subscriber_and_poses_from_tf(tmp_path: Path, client: Client) -> None:
    settings = load(ROOT / 'config' / 'sphere.yaml')
    recording = read(ROOT / 'bags' / 'sphere', settings)
    offline = calibrate(recording.profiles, recording.poses, settings)
    tree = client.node.create_publisher(TFMessage, '/tf', RELIABLE)
    with running_node(tmp_path, '--params-file', str(ROOT / 'config' / 'sphere.yaml'),
                      '-p', 'pose_source:=tf'):
        client.until(lambda: tree.get_subscription_count()
                     and client.profiles.get_subscription_count(), 'the node subscribes')
        client.state()
        client.send(tree, [transforms_of(pose) for pose in recording.poses], rate=1500)
        client.send(client.profiles, [profile_message(p) for p in recording.profiles], rate=400)
        client.until_counted(poses=len(recording.poses), profiles=len(recording.profiles))
        answer = client.call('compute_calibration')
        assert answer.success, answer.message
        late: list[TFMessage] = []
        client.node.create_subscription(TFMessage, '/tf_static', late.append, LATCHED)
        client.until(lambda: late, 'the latched transform comes')
    (transform,) = late[0].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ('flange', 'laser')
    p = transform.transform.translation
    np.testing.assert_allclose([p.x, p.y, p.z], offline.T_flange_sensor[:3, 3], atol=1e-9)


def profile_message(profile) -> PointCloud2:
    columns = dict(zip(('x', 'z'), profile.read().points.T, strict=True))
    return cloud_message(cloud(columns, {'x': (0, 8), 'z': (8, 8)}, 16), profile.stamp)


def transforms_of(pose):
    """Return the pose as a chain of two joints, the first of which does not move."""
    msg = TransformStamped(child_frame_id='flange')
    stamped = pose_message(pose.stamp, pose.translation, pose.quaternion, 'arm')
    msg.header = stamped.header
    msg.transform.rotation = stamped.pose.orientation
    t, p = msg.transform.translation, stamped.pose.position
    t.x, t.y, t.z = p.x, p.y, p.z
    base = TransformStamped(child_frame_id='arm')
    base.header.stamp, base.header.frame_id = stamped.header.stamp, 'base'
    base.transform.rotation.w = 1.0
    return TFMessage(transforms=[base, msg])


def test_without_tf2_msgs_poses_from_tf_are_refused(tmp_path: Path) -> None:
    block = ('import sys; sys.modules["tf2_msgs"] = None; '
             'from handeye_ros.node.main import main; sys.exit(main())')
    run = subprocess.run(
        [sys.executable, '-c', block, '--ros-args', '-p', 'pose_source:=tf'], cwd=ROOT,
        capture_output=True, text=True, check=False, timeout=PATIENCE)
    assert run.returncode == 2
    assert 'pose_source is tf, but tf2_msgs is not installed' in run.stderr


@pytest.mark.thorough
def test_a_solve_loses_no_profiles(tmp_path: Path, client: Client) -> None:
    config = ROOT / 'config' / 'sphere.yaml'
    recording = read(ROOT / 'bags' / 'sphere', load(config))
    with running_node(tmp_path, '--params-file', str(config)):
        client.connect()
        replay(ROOT / 'bags' / 'sphere')
        n, poses = len(recording.profiles), len(recording.poses)
        client.until_counted(profiles=n, poses=poses)
        later = recording.profiles[-1].stamp
        sent = 0

        def publish() -> bool:
            nonlocal sent
            sent += 1
            client.profiles.publish(sphere_profile(later + sent))
            return answer.done()

        service = client.node.create_client(Trigger, '/handeye/compute_calibration')
        client.until(service.service_is_ready, 'the service is there')
        answer = service.call_async(Trigger.Request())
        client.until(publish, 'the solve ends')
        assert answer.result().success, answer.result().message
        assert sent > 1
        client.until_counted(profiles=n + sent)


PARAMETERS = """
/**:
  ros__parameters:
    use_sim_time: true
    start_type_description_service: true
    qos_overrides: {/profile: {subscription: {depth: 10}}}
    target: {type: sphere, radius: 1, size: []}
"""


def test_a_parameter_file_with_empty_lists_and_integers(tmp_path: Path) -> None:
    file, context = tmp_path / 'parameters.yaml', Context()
    file.write_text(PARAMETERS)
    rclpy.init(args=['--ros-args', '--params-file', str(file)], context=context)
    try:
        config, _ = params.declare(Node('handeye', context=context), OutputFolders())
    finally:
        rclpy.shutdown(context=context)
    assert (config.target.type, config.target.radius, config.target.size) == ('sphere', 1.0, ())


@pytest.mark.thorough
@pytest.mark.parametrize(('argument', 'reason'), [
    ('nois.sensor:=1.0', 'unknown key "nois.sensor" in the node\'s parameters; did you mean '
     '"noise.sensor"?'),
    ('profile_topic:=my profile', '"my profile" cannot name a topic'),
    ('target.size:=[1.0, 2]', 'ROS does not start: '),
])
def test_wrong_parameters_end_the_node(argument: str, reason: str) -> None:
    run = run_module('__main__', '--ros-args', '-p', argument)
    assert run.returncode == 2
    assert reason in run.stderr.splitlines()[-1]
    assert 'Traceback' not in run.stderr


@pytest.mark.parametrize(('argument', 'reason'), [
    ('noise.sensor:=abc', "noise.sensor is 'abc', expected a value of type float"),
    ('noise.sensor:=5.0', 'noise.sensor is 5.0, expected a number from 1e-09 to 0.01'),
    ('target.type:=cone', "target.type is 'cone', expected one of"),
    ('target.type:=points', 'target.type points is solved from files, .* "handeye solve'),
    ('name:=a/b', "name is 'a/b', expected the name of a folder"),
    (f'name:={300 * "a"}', "name is 'a{20}...', expected at most 100 characters"),
    ('name:=[]', 'name is \\[], expected a value of type str'),
    ('target.size:=[1.0]', 'target.size is \\[1.0], expected a list of 0 or 2 values'),
    ('name:="  "', "name is '  ', expected a text without control characters, or blanks"),
    ('pose_topic:=""', "pose_topic is '', expected a text such as flange_pose"),
    ('output_dir:="a\\tb"', 'expected a text without control characters'),
    ('output_dir:=3', 'output_dir is 3, expected a value of type str'),
    ('tracker.h0:=1.0', 'unknown key "tracker.h0"'),
])
def test_wrong_parameters(argument: str, reason: str) -> None:
    context = Context()
    rclpy.init(args=['--ros-args', '-p', argument], context=context)
    try:
        with pytest.raises(InputError, match=reason):
            params.declare(Node('handeye', context=context), OutputFolders())
    finally:
        rclpy.shutdown(context=context)


def test_a_best_effort_robot_is_heard_and_a_wrong_type_reported(
        tmp_path: Path, client: Client) -> None:
    poses = client.node.create_publisher(PoseStamped, '/robot/pose', BEST_EFFORT)
    client.node.create_publisher(PointStamped, '/scan', RELIABLE)
    cause = ('(it carries geometry_msgs/msg/PointStamped, expected sensor_msgs/msg/PointCloud2; '
             'sensor_msgs/msg/PointCloud2 is on /profile: set profile_topic)')
    with running_node(tmp_path, '-p', 'pose_topic:=/robot/pose', '-p', 'profile_topic:=/scan'):
        client.until(poses.get_subscription_count, 'the node subscribes')
        client.state()
        client.send(poses, [pose_message(10**18 + i) for i in range(5)], rate=20)
        client.until(lambda: client.state()['poses'] != '0', 'a pose is counted')
        client.until(lambda: cause in client.state()['message'], 'it says what is there')
        assert all(cause in client.call(service).message
                   for service in ('take_sample', 'compute_calibration'))
    assert cause in (tmp_path / 'node.log').read_text()
