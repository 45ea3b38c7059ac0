# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The services and parameters of a running node, over real DDS."""
from __future__ import annotations

import array
from collections.abc import Iterator
import subprocess
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
from contract import listed, offered  # noqa: E402, I100
from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from geometry_msgs.msg import TransformStamped  # noqa: E402
from rcl_interfaces.msg import SetParametersResult  # noqa: E402
from rcl_interfaces.srv import DescribeParameters, SetParameters  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from ros_helpers import Client, LATCHED, pose_message, running_node, sphere_profile  # noqa: E402
from sensor_msgs.msg import PointCloud2  # noqa: E402
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


@pytest.fixture(scope='module')
def client() -> Iterator[Client]:
    """Give one client to all tests: a new one is discovered in some seconds only."""
    client = Client()
    yield client
    client.close()


@pytest.fixture
def node(process: subprocess.Popen[str], client: Client) -> subprocess.Popen[str]:
    """Connect to a node that is as if just started, but for its counts."""
    client.connect()
    assert client.call('clear_samples').success
    assert client.call('auto_sample', SetBool.Request(data=True)).success
    assert set_parameter(client, 'target.radius', 0.04).successful
    return process


def stand_still(client: Client, start: int, seconds: float = 1.0, x: float = 0.0,
                frame_id: str = 'laser') -> None:
    """Publish a robot that stands still, and what its sensor sees."""
    for stamp in range(start, start + round(seconds * NS), NS // 20):
        client.poses.publish(pose_message(stamp, (x, 0.0, 0.0)))
        client.profiles.publish(sphere_profile(stamp + 1, frame_id))


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


def test_it_offers_what_the_contract_lists(client: Client, node: subprocess.Popen[str]) -> None:
    client.until(lambda: listed() <= offered(client), 'it offers all that docs/contract.md lists')


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


@pytest.mark.parametrize(('change', 'cause'), [
    (lambda cloud: setattr(cloud, 'point_step', 0), 'point_step'),
    (lambda cloud: cloud.fields.pop(), 'no fields are named "z"'),
    (lambda cloud: cloud.data.__setitem__(slice(None), millimetres(cloud)),
     'set profile.unit to mm')], ids=['point_step 0', 'no z', 'millimetres'])
def test_the_cause_of_a_stream_that_breaks_off_is_in_every_answer(
        client: Client, node: subprocess.Popen[str], change: Any, cause: str) -> None:
    stand_still(client, START)
    client.until_counted(profiles=20, poses=20)
    for number in range(5):
        broken = sphere_profile(START + 2 * NS + number * NS // 4)
        change(broken)
        client.profiles.publish(broken)
    state = client.until_counted(malformed=5, profiles=20)
    for text in (state['message'], client.call('take_sample').message):
        assert 'the last 5 profiles cannot be used; the last reason: ' in text and cause in text


def test_a_stream_that_was_never_usable_says_why(
        client: Client, node: subprocess.Popen[str]) -> None:
    assert set_parameter(client, 'profile.unit', 'mm').successful
    stand_still(client, START)
    state = client.until_counted(malformed=20, poses=20)
    for text in (state['message'], client.call('take_sample').message):
        assert 'profiles cannot be used; the last reason: ' in text
        assert 'set profile.unit to m' in text
    assert set_parameter(client, 'profile.unit', 'm').successful


def millimetres(cloud: PointCloud2) -> array.array:
    return array.array('B', (1e3 * np.frombuffer(cloud.data, '<f4')).astype('<f4').tobytes())


def test_a_stray_of_another_frame_is_ignored_and_two_sensors_are_refused(
        client: Client, node: subprocess.Popen[str]) -> None:
    stand_still(client, START)
    client.profiles.publish(sphere_profile(START + NS, 'right'))
    client.poses.publish(pose_message(START + NS, frame_id='map'))
    state = client.until_counted(profiles=21, poses=21)
    assert 'dropped a profile of frame "right" (1 times)' in state['dropped']
    assert client.call('take_sample').success
    stand_still(client, START + 2 * NS, 0.25, frame_id='right')
    client.until_counted(profiles=26, poses=26)
    for service in ('take_sample', 'compute_calibration'):
        answer = client.call(service)
        assert not answer.success
        assert 'the profile topic carries two frames, "laser" and "right"' in answer.message
    assert client.call('clear_samples').success
    client.profiles.publish(sphere_profile(START + 3 * NS, 'right'))
    client.until_counted(profiles=27)
    assert 'two frames' not in client.state()['message'], 'the next one counts'


def test_a_clock_that_is_set_back_takes_nothing_that_is_not(
        client: Client, node: subprocess.Popen[str]) -> None:
    assert client.call('auto_sample', SetBool.Request(data=False)).success
    stand_still(client, START)
    client.until_counted(profiles=20, poses=20)
    assert client.call('take_sample').success
    back = START - 60 * NS
    stand_still(client, back, 0.25, x=0.193)
    state = client.until_counted(profiles=25, poses=25)
    assert state['level'] == DiagnosticStatus.WARN
    assert 'are dropped, as their stamps are older than those before' in state['message']
    answer = client.call('take_sample')
    assert not answer.success and 'the robot position is not known' in answer.message
    stand_still(client, back + NS // 4, 1.75, x=0.193)
    state = client.until_counted(profiles=60, poses=60)
    assert 'the clock of the poses was set back by 6' in state['dropped']
    assert 'older than those before' not in state['message']
    answer = client.call('take_sample')
    assert answer.success and answer.message.startswith('sample 2 taken: '), answer.message


def test_a_stop_is_judged_while_the_robot_stands(
        client: Client, node: subprocess.Popen[str]) -> None:
    stand_still(client, START, 1.1)
    client.until(lambda: client.state()['samples'] == '1', 'the stop is a sample')
    stand_still(client, START + 22 * NS // 20)  # it stays: no second one
    stand_still(client, START + 3 * NS, 0.2, x=0.1)
    client.until_counted(profiles=46, poses=46)
    assert client.call('remove_last_sample').message.startswith('removed sample 1, the last one')
    assert client.state()['samples'] == '0'


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
    keys = ['noise.sensor', 'profile.axes', 'page.port', 'output_dir', 'sampling.min_points']
    report = client.request(DescribeParameters, 'describe_parameters',
                            DescribeParameters.Request(names=keys)).descriptors
    sensor, axes, port, folder, points = report
    assert 'Range noise' in sensor.description
    assert (sensor.floating_point_range[0].from_value, sensor.floating_point_range[0].to_value
            ) == (1e-9, 0.01)
    assert 'one of x, y, z, -x, -y, -z' in axes.additional_constraints
    assert 'fixed while the node runs' in port.additional_constraints
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
            ('profile_topic', 'a b', '"a b" cannot name a topic'),
            ('profile_topic', '/flange_pose', 'each needs its own'),
            ('page.port', 1234, 'page.port is fixed while the node runs')):
        result = set_parameter(client, name, value)
        assert (result.successful, reason in result.reason) == (False, True), result.reason
    stand_still(client, START)
    client.until_counted(profiles=20, poses=20)
    assert client.call('take_sample').success
    assert 'clear_samples first' in set_parameter(client, 'profile_topic', '/other').reason
    assert set_parameter(client, 'sampling.min_points', 5000).successful
    client.until(lambda: client.state()['samples'] == '0', 'the sample is extracted again')
    assert set_parameter(client, 'sampling.min_points', 20).successful
    client.until(lambda: client.state()['samples'] == '1', 'the sample is back')


def test_other_topics_are_heard_while_the_node_runs(
        client: Client, node: subprocess.Popen[str]) -> None:
    assert set_parameter(client, 'profile_topic', '/other').successful
    client.until(lambda: not client.profiles.get_subscription_count(), 'it hears no more there')
    client.until(lambda: '/other has no publisher' in client.state()['message'], 'it says so')
    assert set_parameter(client, 'profile_topic', '/profile').successful
    client.until(lambda: client.profiles.get_subscription_count()
                 and client.poses.get_subscription_count(), 'it hears again')
    stand_still(client, START)
    client.until(lambda: client.call('take_sample').success, 'a sample is taken')
