# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The node in its own process, over real DDS: recordings through it, and its parameters."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from handeye_ros.bags.recording import read_bag
from handeye_ros.config import load
from handeye_ros.errors import InputError
from handeye_ros.pipeline import calibrate
from handeye_ros.results.calibration_file import read_calibration
from handeye_ros.results.truth import true_transform
import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from command import PATIENCE, run_python, succeeds  # noqa: E402, I100
from geometry_msgs.msg import PoseStamped, TransformStamped  # noqa: E402
from handeye_ros.node.folders import OutputFolders  # noqa: E402
from handeye_ros.node.node import declare_settings  # noqa: E402
from handeye_ros.node.outputs import current_markers, session_markers  # noqa: E402
from live_sessions import computed, feed, new  # noqa: E402
from live_sessions import SPHERE as CELL  # noqa: E402
import rclpy  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.node import Node  # noqa: E402
from ros_clouds import cloud  # noqa: E402
from ros_helpers import (  # noqa: E402
    Client,
    cloud_message,
    LATCHED,
    pose_message,
    RELIABLE,
    replay,
    ROOT,
    running_node,
    sphere_profile,
)
from sensor_msgs.msg import PointCloud2  # noqa: E402
from std_msgs.msg import String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from visualization_msgs.msg import Marker, MarkerArray  # noqa: E402

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

pytestmark = pytest.mark.ros

PLATE, SPHERE = ROOT / 'config' / 'plate.yaml', ROOT / 'config' / 'sphere.yaml'


def received_on(client: Client, kind: type, topic: str, qos: object = LATCHED) -> list:
    """Return what will hold the messages of a topic."""
    messages: list = []
    client.node.create_subscription(kind, topic, messages.append, qos)
    return messages


def test_a_bag_through_the_node_gives_the_offline_result(tmp_path: Path, client: Client) -> None:
    settings, bag = load(PLATE), ROOT / 'bags' / 'plate'
    recording = read_bag(bag, settings)
    offline = calibrate(recording.profiles, recording.poses, settings)
    n = offline.quality.samples_used + offline.quality.samples_rejected
    features = received_on(client, PointCloud2, '/handeye/features', 100)
    markers = received_on(client, MarkerArray, '/handeye/markers')
    texts = received_on(client, String, '/handeye/guidance')
    poses = received_on(client, PoseStamped, '/handeye/next_pose')
    with running_node(tmp_path, '--params-file', str(PLATE), '-p', 'guidance.accuracy:=1e-5'):
        client.connect()
        client.until(lambda: client.node.count_publishers('/handeye/features'), 'all is there')
        client.until(lambda: texts, 'there is advice before the first sample')
        assert texts[0].data.startswith('Take the first sample: ')
        replay(bag)
        client.until_counted(profiles=len(recording.profiles), poses=len(recording.poses),
                             malformed=0)
        answer = client.call('compute_calibration')
        assert answer.success, answer.message
        assert f'{offline.quality.samples_used} samples used' in answer.message
        calibrations = received_on(client, TransformStamped, '/handeye/calibration')
        client.until(lambda: calibrations, 'the latched calibration comes')
        saved = client.call('save_calibration')
        path = tmp_path / settings.name / 'calibration.yaml'
        assert (saved.success, saved.message) == (True, f'wrote {path}')
        client.until(lambda: len(markers[-1].markers) > n + 3, 'the target is drawn')
        client.until(lambda: poses, 'a pose is proposed')
        client.until(lambda: 'points in view are known to' in texts[-1].data.lower(),
                     'the words say how well it is known')
        assert client.call('remove_last_sample').success
        again = client.call('save_calibration').message
        assert again.startswith(f'saved already: {path}; ') and '(1 removed)' in again
        assert client.call('clear_samples').success
        client.until(lambda: texts[-1].data.startswith('Take the first sample'),
                     'the advice starts again')
        late_calibrations = received_on(client, TransformStamped, '/handeye/calibration')
        client.state()
        assert not late_calibrations, 'a late joiner is not sent an old answer'
    p, first = poses[-1].pose.position, next(iter(recording.poses)).translation
    assert np.linalg.norm(np.array([p.x, p.y, p.z]) - first) <= settings.guidance.reach + 1e-3
    assert poses[-1].header.frame_id == 'base'
    online = read_calibration(path)
    np.testing.assert_allclose(online.T_flange_sensor, offline.T_flange_sensor, atol=1e-9, rtol=0)
    np.testing.assert_allclose(online.covariance, offline.covariance, rtol=1e-6, atol=1e-15)
    # sums over arrays that went to another process may differ in the last digit
    assert [replace(s, residual=0.0) for s in online.samples] == [
        replace(s, residual=0.0) for s in offline.samples]
    *topics, session = online.provenance['inputs']
    assert topics == [{'topic': '/profile'}, {'topic': '/flange_pose'}]
    assert Path(session['session']).parent == path.parent
    assert len(features) == n and {f.header.frame_id for f in features} == {'laser'}
    transform = calibrations[0].transform.translation
    assert (calibrations[0].header.frame_id, calibrations[0].child_frame_id) == ('flange', 'laser')
    np.testing.assert_allclose([transform.x, transform.y, transform.z],
                               offline.T_flange_sensor[:3, 3], atol=1e-9)
    assert 'Traceback' not in (tmp_path / 'node.log').read_text()


@pytest.mark.thorough
@pytest.mark.skipif(TFMessage is None, reason='tf2_msgs is not built: make tf2_msgs')
def test_poses_come_from_tf_and_tf_static_is_latched(tmp_path: Path, client: Client) -> None:
    settings = load(SPHERE)
    recording = read_bag(ROOT / 'bags' / 'sphere', settings)
    offline = calibrate(recording.profiles, recording.poses, settings)
    tree = client.node.create_publisher(TFMessage, '/tf', RELIABLE)
    clouds = [cloud(dict(zip('xz', profile.read().points.T, strict=True)),
                    {'x': (0, 8), 'z': (8, 8)}, 16) for profile in recording.profiles]
    with running_node(tmp_path, '--params-file', str(SPHERE), '-p', 'pose_source:=tf'):
        client.until(lambda: tree.get_subscription_count()
                     and client.profiles.get_subscription_count(), 'the node subscribes')
        client.state()
        client.send(tree, [transforms_of(pose) for pose in recording.poses], rate=1500)
        client.send(client.profiles, [cloud_message(scan, profile.stamp) for scan, profile in
                                      zip(clouds, recording.profiles, strict=True)], rate=400)
        client.until_counted(poses=len(recording.poses), profiles=len(recording.profiles))
        answer = client.call('compute_calibration')
        assert answer.success, answer.message
        messages = received_on(client, TFMessage, '/tf_static')
        client.until(lambda: messages, 'the latched transform comes')
    (transform,) = messages[0].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ('flange', 'laser')
    p = transform.transform.translation
    np.testing.assert_allclose([p.x, p.y, p.z], offline.T_flange_sensor[:3, 3], atol=1e-9)


def transforms_of(pose):
    """Return the pose as a chain of two joints, the first of which does not move."""
    stamped = pose_message(pose.stamp, pose.translation, pose.quaternion, 'arm')
    flange = TransformStamped(header=stamped.header, child_frame_id='flange')
    flange.transform.rotation = stamped.pose.orientation
    t, p = flange.transform.translation, stamped.pose.position
    t.x, t.y, t.z = p.x, p.y, p.z
    base = TransformStamped(child_frame_id='arm')
    base.header.stamp, base.header.frame_id = stamped.header.stamp, 'base'
    base.transform.rotation.w = 1.0
    return TFMessage(transforms=[base, flange])


def test_without_tf2_msgs_poses_from_tf_are_refused(tmp_path: Path) -> None:
    block = ('import sys; sys.modules["tf2_msgs"] = None; '
             'from handeye_ros.node.calibrate import main; sys.exit(main())')
    run = run_python('-c', block, '--ros-args', '-p', 'pose_source:=tf', timeout=PATIENCE)
    assert run.returncode == 2
    assert 'pose_source is tf, but tf2_msgs is not installed' in run.stderr


@pytest.mark.thorough
def test_a_session_corrects_the_arm_and_loses_no_profiles(tmp_path: Path, client: Client) -> None:
    pytest.importorskip('pinocchio', reason='needs pinocchio')
    bag = ROOT / 'bags' / 'arm'
    recording = read_bag(bag, load(SPHERE))
    n, end, sent = len(recording.profiles), recording.profiles[-1].stamp, 0
    with running_node(tmp_path, '-p', 'target.type:=sphere'):
        client.connect()
        replay(bag)
        client.until_counted(profiles=n)
        service = client.node.create_client(Trigger, '/handeye/compute_calibration')
        client.until(service.service_is_ready, 'the service is there')
        answer = service.call_async(Trigger.Request())

        def publish() -> bool:
            nonlocal sent
            sent += 1
            client.profiles.publish(sphere_profile(end + sent))
            return answer.done()

        client.until(publish, 'the solve ends')
        assert answer.result().success, answer.result().message
        client.until_counted(profiles=n + sent)
    session, = (path for path in (tmp_path / 'sphere').iterdir() if path.is_dir())
    succeeds('kinematics', session, '--urdf', bag / 'robot.urdf', '--out', tmp_path / 'arm',
             cwd=tmp_path)
    calibration = read_calibration(tmp_path / 'arm' / 'calibration.yaml')
    assert calibration.quality.holdout_rms < 6e-5, 'a fifth of that with the arm as stated'
    X, sigma = calibration.T_flange_sensor, np.sqrt(np.diag(calibration.covariance))[:3]
    assert (np.abs(X - true_transform(bag))[:3, 3] < 4 * sigma).all()


# -- markers


def points(markers: MarkerArray, name: str) -> np.ndarray:
    """Return the points of markers with a name."""
    return np.array([[p.x, p.y, p.z] for marker in markers.markers if marker.ns == name
                     for p in marker.points])


def test_samples_and_the_profile_of_now_lie_on_the_target() -> None:
    live = new()
    middle = CELL.poses[len(CELL.poses) // 2].stamp
    items = [*CELL.poses, *CELL.profiles]
    feed(live, [item for item in items if item.stamp < middle])
    current = live.current_snapshot()
    assert current
    feed(live, [item for item in items if item.stamp >= middle])
    stops = live.session_copy().stops
    before = session_markers(stops, None, CELL.config)
    assert before.markers[0].action == Marker.DELETEALL
    assert {marker.ns for marker in before.markers[1:]} == {'flanges', 'numbers'}
    assert [m.text for m in before.markers if m.text] == [str(o.number) for o in stops if o.sample]
    assert len(current_markers(current, None, CELL.config).markers) == 1
    computed(live)
    of_session = session_markers(stops, live.solver.calibration, CELL.config)
    of_current = current_markers(current, live.solver.calibration, CELL.config)
    assert {m.header.frame_id for m in [*of_session.markers, *of_current.markers]} == {'base'}
    assert len({(m.ns, m.id) for m in of_session.markers}) == len(of_session.markers)
    centre = np.array([live.solver.calibration.target['centre'][axis] for axis in 'xyz'])
    for drawn in (points(of_session, 'what the answer comes from'), points(of_current, 'feature')):
        np.testing.assert_allclose(np.linalg.norm(drawn - centre, axis=1), 0.04, atol=5e-4)
    assert len(points(of_current, 'profile')) >= len(points(of_current, 'feature')) > 10
    first, *others = live.solver.calibration.samples
    without = session_markers(stops, replace(
        live.solver.calibration, samples=(replace(first, used=False), *others)), CELL.config)
    shown, of_fewer = (len(points(each, 'what the answer comes from'))
                       for each in (of_session, without))
    assert 0 < of_fewer < shown, 'a sample that is not used is no source of the answer'


# -- parameters


def declared(*arguments: str):
    """Return the configuration of a node with these arguments."""
    context = Context()
    rclpy.init(args=['--ros-args', *arguments], context=context)
    node = Node('declared', context=context)  # no second /handeye for the tests that follow
    try:
        return declare_settings(node, OutputFolders())[0]
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


PARAMETERS = """
/**:
  ros__parameters:
    use_sim_time: true
    start_type_description_service: true
    qos_overrides: {/profile: {subscription: {depth: 10}}}
    target: {type: sphere, radius: 1, size: []}
"""


def test_a_parameter_file_may_hold_empty_lists_and_integers(tmp_path: Path) -> None:
    (tmp_path / 'parameters.yaml').write_text(PARAMETERS)
    config = declared('--params-file', str(tmp_path / 'parameters.yaml'))
    assert (config.target.type, config.target.radius, config.target.size) == ('sphere', 1.0, ())


@pytest.mark.parametrize(('argument', 'reason'), [
    ('noise.sensor:=abc', "noise.sensor is 'abc', expected a number from 1e-09 to 0.01 m"),
    ('sensor_frame:=camera -p target.type:=points', 'target.type points is solved from files'),
    ('name:=a/b', "name is 'a/b', expected the name of a folder"),
    ('target.size:=[1.0]', 'target.size is \\[1.0], expected a list of 0 or 2 values'),
    ('nois.sensor:=1.0', 'unknown key "nois.sensor" .*; did you mean "noise.sensor"?'),
])
def test_wrong_parameters_are_refused_by_name(argument: str, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        declared('-p', *argument.split())
