"""The services and parameters of a running node, over real DDS."""
from __future__ import annotations

from collections.abc import Iterator
import subprocess

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402, I100
from geometry_msgs.msg import TransformStamped  # noqa: E402
from rcl_interfaces.msg import SetParametersResult  # noqa: E402
from rcl_interfaces.srv import DescribeParameters, SetParameters  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from ros_helpers import Client, LATCHED, pose_message, running_node, sphere_profile  # noqa: E402
from std_srvs.srv import SetBool, Trigger  # noqa: E402

pytestmark = pytest.mark.ros

NS = 1_000_000_000
START = 1_700_000_000 * NS
SPHERE = ('-p', 'target.type:=sphere', '-p', 'target.radius:=0.04', '-p',
          'profile_topic:=/profile', '-p', 'pose_topic:=/flange_pose')


@pytest.fixture(scope='module')
def process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[subprocess.Popen[str]]:
    """Run a node that looks for a sphere, for all tests that leave it running."""
    with running_node(tmp_path_factory.mktemp('node'), *SPHERE) as process:
        yield process


@pytest.fixture
def node(process: subprocess.Popen[str], client: Client) -> subprocess.Popen[str]:
    """Connect to a node that is as if just started, but for its counts."""
    client.connect()
    assert client.call('clear_samples').success
    assert client.call('auto_sample', SetBool.Request(data=True)).success
    assert set_parameter(client, 'target.radius', 0.04).successful
    return process


def stand_still(client: Client, start: int, seconds: float = 1.0) -> None:
    """Publish a robot that stands still, and what its sensor sees."""
    for stamp in range(start, start + round(seconds * NS), NS // 20):
        client.poses.publish(pose_message(stamp))
        client.profiles.publish(sphere_profile(stamp + 1))


def set_parameter(client: Client, name: str, value: object) -> SetParametersResult:
    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
    return client.request(SetParameters, 'set_parameters', request).results[0]


def test_refusals_say_why_and_what_to_do(client: Client, node: subprocess.Popen[str]) -> None:
    published: list[TransformStamped] = []
    client.node.create_subscription(TransformStamped, '/handeye/calibration', published.append,
                                    LATCHED)
    for service, reason in (
            ('take_sample', 'no flange pose was received on /flange_pose: start the robot driver'),
            ('remove_last_sample', 'there is no sample to remove'),
            ('compute_calibration', 'no flange pose was received'),
            ('save_calibration', 'there is no calibration to save: call ~/compute_calibration')):
        answer = client.call(service)
        assert (answer.success, reason in answer.message) == (False, True), answer.message
    state = client.state()
    assert state['level'] == DiagnosticStatus.OK or 'no profiles on /profile' in state['message']
    assert not published


def test_samples_by_hand(client: Client, node: subprocess.Popen[str]) -> None:
    answer = client.call('auto_sample', SetBool.Request(data=False))
    assert (answer.success, answer.message) == (True, 'samples are taken by ~/take_sample only')
    stand_still(client, START)
    assert client.until_counted(profiles=20, poses=20)['samples'] == '0'
    taken = client.call('take_sample')
    assert taken.success, taken.message
    assert taken.message.startswith('sample 1 taken: 1 arc from ')
    few = client.call('compute_calibration')
    assert not few.success
    assert 'needs at least' in few.message
    removed = client.call('remove_last_sample')
    assert removed.message.endswith('0 left'), removed.message
    assert client.call('take_sample').success
    assert client.call('clear_samples').message.startswith('1 sample removed')
    assert client.state()['samples'] == '0'


def test_malformed_messages_are_counted_and_stop_nothing(
        client: Client, node: subprocess.Popen[str]) -> None:
    good = sphere_profile(START)
    for changes in ({'width': 2**31}, {'point_step': 0}, {'fields': []}, {'data': b'12'}):
        bad = sphere_profile(START)
        for name, value in changes.items():
            setattr(bad, name, value)
        client.profiles.publish(bad)
    client.poses.publish(pose_message(START, orientation=(0, 0, 0, 0)))
    client.poses.publish(pose_message(START, position=(float('nan'), 0, 0)))
    client.profiles.publish(good)
    client.poses.publish(pose_message(START))
    state = client.until_counted(malformed=6, profiles=1, poses=1)
    assert 'message not used: ' in state['last malformed']
    assert node.poll() is None


def test_two_frames_on_one_topic(client: Client, node: subprocess.Popen[str]) -> None:
    client.profiles.publish(sphere_profile(START, 'left'))
    client.profiles.publish(sphere_profile(START + 1, 'right'))
    client.poses.publish(pose_message(START))
    state = client.until_counted(profiles=2, poses=1)
    assert 'dropped a profile of frame "right"' in state['dropped']
    answer = client.call('compute_calibration')
    assert not answer.success
    assert 'the profile topic carries two frames, "left" and "right"' in answer.message


def test_a_looping_bag_is_explained_and_may_start_again(
        client: Client, node: subprocess.Popen[str]) -> None:
    stand_still(client, START)
    client.until_counted(profiles=20, poses=20)
    stand_still(client, START)
    state = client.until_counted(profiles=40, poses=40)
    assert 'clear the samples if a bag was started again (20 times)' in state['dropped']
    assert state['level'] == DiagnosticStatus.WARN
    late = ('poses and profiles are dropped, as their stamps are older than those before: call '
            '~/clear_samples if a bag was started again')
    assert late in state['message']
    assert client.call('compute_calibration').message.endswith(late)
    assert client.call('clear_samples').success
    assert 'dropped' not in client.state()['message']
    stand_still(client, START)
    client.until_counted(profiles=60, poses=60)
    assert client.state()['dropped'] == ''
    assert client.call('take_sample').success


def test_one_wild_stamp_makes_nothing_else_late(
        client: Client, node: subprocess.Popen[str]) -> None:
    stand_still(client, START, 0.3)
    for stamp in (0, START + 10**9 * NS, 1):  # 0: the time of receipt, years after START
        client.profiles.publish(sphere_profile(stamp))
        client.poses.publish(pose_message(stamp))
        stand_still(client, START + 3 * NS // 10 + 5 * (stamp % 7) * NS // 100, 0.05)
    stand_still(client, START + 6 * NS // 10)
    state = client.until_counted(profiles=32, poses=32)
    assert 'older than those before' not in state['message']
    taken = client.call('take_sample')
    assert taken.success, taken.message


def test_profiles_without_a_frame(client: Client, node: subprocess.Popen[str]) -> None:
    client.profiles.publish(sphere_profile(START, ''))
    state = client.until_counted(profiles=1)
    assert 'have no frame_id: the result calls their frame "sensor"' in state['dropped']


def test_one_spot_is_one_sample_however_often_it_is_taken(
        client: Client, node: subprocess.Popen[str]) -> None:
    stand_still(client, START)
    client.until_counted(profiles=20, poses=20)
    assert client.call('take_sample').message.startswith('sample 1 taken: ')
    services = [client.node.create_client(Trigger, '/handeye/take_sample') for _ in range(3)]
    for service in services:
        client.until(service.service_is_ready, 'the service is there')
    answers = [service.call_async(Trigger.Request()) for service in services for _ in range(9)]
    client.until(lambda: all(answer.done() for answer in answers), 'all are answered')
    again = 'sample 1 taken again, as the robot has not moved since: '
    assert all(answer.result().message.startswith(again) for answer in answers)
    assert client.state()['samples'] == '1'


def test_messages_without_stamp_get_the_time_of_receipt(
        client: Client, node: subprocess.Popen[str]) -> None:
    for _ in range(5):
        client.profiles.publish(sphere_profile(0))
    assert client.until_counted(profiles=5)['dropped'] == ''


def test_parameters_explain_themselves(client: Client, node: subprocess.Popen[str]) -> None:
    keys = ['noise.sensor', 'profile.axes', 'profile_topic', 'output_dir', 'sampling.min_points']
    told = client.request(DescribeParameters, 'describe_parameters',
                          DescribeParameters.Request(names=keys)).descriptors
    sensor, axes, topic, folder, points = told
    assert 'Range noise' in sensor.description
    assert (sensor.floating_point_range[0].from_value, sensor.floating_point_range[0].to_value
            ) == (1e-9, 0.01)
    assert 'one of x, y, z, -x, -y, -z' in axes.additional_constraints
    assert 'fixed while the node runs' in topic.additional_constraints
    assert 'ROS_HOME' in folder.description
    assert points.integer_range[0].to_value == 100000


def test_parameters_at_run_time(client: Client, node: subprocess.Popen[str]) -> None:
    assert set_parameter(client, 'limits.residual', 0.002).successful
    assert set_parameter(client, 'target.radius', 1).successful, 'an int where a float is meant'
    assert set_parameter(client, 'target.radius', 0.04).successful
    for name, value, reason in (
            ('limits.residual', 3.0, 'Max: 1.0'),
            ('noise.sensor', 'loud', "noise.sensor is 'loud', expected a value of type float"),
            ('profile.axes', ['x', '-x'], 'two different axes'),
            ('target.type', 'cone', "target.type is 'cone', expected one of"),
            ('name', 'a/b', 'expected the name of a folder'),
            ('profile_topic', '/other', 'profile_topic is fixed while the node runs')):
        result = set_parameter(client, name, value)
        assert (result.successful, reason in result.reason) == (False, True), result.reason
    stand_still(client, START)
    client.until_counted(profiles=20, poses=20)
    assert client.call('take_sample').success
    assert set_parameter(client, 'sampling.min_points', 5000).successful
    client.until(lambda: client.state()['samples'] == '0', 'the sample is extracted anew')
    assert set_parameter(client, 'sampling.min_points', 20).successful
    client.until(lambda: client.state()['samples'] == '1', 'the sample is back')
