# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The services and parameters of a running node, over real DDS."""
from __future__ import annotations

import array
from collections.abc import Iterator
from itertools import count
import json
import os
from pathlib import Path
import re
import subprocess

import numpy as np
import pytest
import yaml

pytest.importorskip('rclpy', reason='needs rclpy')
from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402, I100
from geometry_msgs.msg import PointStamped, PoseStamped  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from ros_clouds import cloud  # noqa: E402
from ros_helpers import (  # noqa: E402
    BEST_EFFORT,
    Client,
    cloud_message,
    listed,
    offered,
    parameter,
    pose_message,
    RELIABLE,
    ROOT,
    running_node,
    set_parameter,
    sphere_profile,
    stand_still,
    XZ,
)
from std_srvs.srv import SetBool, Trigger  # noqa: E402

pytestmark = pytest.mark.ros

NS = 1_000_000_000
START = 1_700_000_000 * NS
RVIZ_TYPES = {'MarkerArray': 'visualization_msgs/msg/MarkerArray',
              'PointCloud2': 'sensor_msgs/msg/PointCloud2',
              'Pose': 'geometry_msgs/msg/PoseStamped'}
SPHERE = ('-p', 'target.type:=sphere', '-p', 'target.radius:=0.04', '-p',
          'profile_topic:=/profile', '-p', 'pose_topic:=/flange_pose')


@pytest.fixture(scope='module')
def process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[subprocess.Popen[str]]:
    """Run a node that looks for a sphere, for all tests that leave it running."""
    with running_node(tmp_path_factory.mktemp('node'), *SPHERE) as process:
        yield process


@pytest.fixture(scope='module', name='client')
def shared_client() -> Iterator[Client]:
    """Give one client to all tests: a new one is discovered in some seconds only."""
    client = Client()
    yield client
    client.close()


@pytest.fixture
def node(process: subprocess.Popen[str], client: Client) -> subprocess.Popen[str]:
    """Connect to a node that is as if just started, but for its counts."""
    client.connect()
    client.until(lambda: 'two nodes' not in client.state()['message'], 'one before is forgotten')
    assert client.call('clear_samples').success
    assert client.call('auto_sample', SetBool.Request(data=True)).success
    assert set_parameter(client, 'target.radius', 0.04).successful
    return process


def test_it_offers_what_the_contract_lists_and_the_layouts_show(client, node):
    client.until(lambda: listed() <= offered(client), 'it offers all that docs/contract.md lists')
    panels = json.loads((ROOT / 'foxglove' / 'handeye.json').read_text())['configById'].values()
    used = {name for panel in panels for name in (
        *panel.get('topics', ()), panel.get('topicToRender', ''),
        re.split(r'[.\[{]', panel.get('topicPath', ''))[0])} - {''}
    services = {panel['serviceName'] for panel in panels if 'serviceName' in panel}
    assert services
    graph = client.node  # which learns of the topics one by one
    client.until(lambda: used <= dict(graph.get_topic_names_and_types()).keys(),
                 'it has the topics of all panels')
    client.until(lambda: services <= dict(graph.get_service_names_and_types()).keys(),
                 'it has the services of all panels')
    topics = dict(graph.get_topic_names_and_types())
    displays = yaml.safe_load((ROOT / 'rviz' / 'handeye.rviz').read_text())[
        'Visualization Manager']['Displays']
    for display in (one for one in displays if 'Topic' in one):
        topic, kind = display['Topic'], display['Class'].removeprefix('rviz_default_plugins/')
        assert topics.get(topic['Value']) == [RVIZ_TYPES[kind]], topic['Value']
        infos = graph.get_publishers_info_by_topic(topic['Value'])
        if infos:  # a display that wants more than is offered gets nothing
            durable = infos[0].qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
            assert durable or topic['Durability Policy'] == 'Volatile'


def test_nothing_listens_but_dds(node):
    rows = [line.split() for name in ('tcp', 'tcp6')
            for line in Path(f'/proc/{node.pid}/net/{name}').read_text().splitlines()[1:]]
    listening = {f'socket:[{row[9]}]' for row in rows if row[3] == '0A'}  # TCP_LISTEN
    descriptors = {os.readlink(file) for file in Path(f'/proc/{node.pid}/fd').iterdir()}
    assert any(name.startswith('socket:') for name in descriptors), 'DDS has sockets'
    assert not descriptors & listening, 'no TCP port is open by default'


def test_samples_are_taken_and_removed_by_hand_or_refused(client, node):
    for service, reason in (
            ('take_sample', 'no flange pose was received on /flange_pose'),
            ('remove_last_sample', 'there is no sample to remove'),
            ('compute_calibration', 'no flange pose was received'),
            ('save_calibration', 'there is no calibration to save: call'),
            ('verify_result', 'no verification was started')):
        answer = client.call(service)
        assert (answer.success, reason in answer.message) == (False, True), answer.message
    answer = client.call('auto_sample', SetBool.Request(data=False))
    assert (answer.success, answer.message) == (True, 'sampling.mode is manual')
    stand_still(client, START)
    assert client.until_counted(profiles=20, poses=20)['samples'] == '0'
    answer = client.call('take_sample')
    assert answer.success and answer.message.startswith('sample 1 taken: 1 arc from ')
    services = [client.node.create_client(Trigger, '/handeye/take_sample') for _ in range(3)]
    for service in services:
        client.until(service.service_is_ready, 'the service is there')
    answers = [service.call_async(Trigger.Request()) for service in services for _ in range(9)]
    client.until(lambda: all(answer.done() for answer in answers), 'all are answered')
    again = 'sample 1 taken again, of the same stop: '
    assert all(answer.result().message.startswith(again) for answer in answers)
    answer = client.call('compute_calibration')
    assert not answer.success and 'needs at least' in answer.message
    assert client.call('remove_last_sample').message.endswith('0 left')
    assert client.call('take_sample').success
    assert set_parameter(client, 'samples.exclude', [1]).successful
    assert client.call('clear_samples').message.startswith('1 sample removed')
    assert client.state()['samples'] == '0'
    client.until(lambda: not parameter(client, 'samples.exclude'), 'ROS shows it')
    stand_still(client, START + 100 * 10**9)  # numbers begin again, and none is excluded
    client.until_counted(profiles=40, poses=40)
    assert client.call('take_sample').message.startswith('sample 1 taken: ')
    client.until(lambda: client.state()['samples'] == '1', 'it is told')
    assert 'excluded' not in client.call('compute_calibration').message


def test_every_answer_names_the_cause_of_malformed_messages(client, node):
    later = START + 10 * NS  # the points are looked at once a second
    for changes in ({'width': 2**31}, {'point_step': 0}, {'fields': []}, {'data': b'12'}):
        malformed = sphere_profile(later)
        for name, value in changes.items():
            setattr(malformed, name, value)
        client.profiles.publish(malformed)
    client.poses.publish(pose_message(START, orientation=(0, 0, 0, 0)))
    client.poses.publish(pose_message(START, position=(float('nan'), 0, 0)))
    stand_still(client, START)
    state = client.until_counted(malformed=6, profiles=20, poses=20)
    assert 'message not used: ' in state['last malformed'] and node.poll() is None
    for number in range(16):
        profile = sphere_profile(START + 2 * NS + number * NS // 4)
        millimetres = 1e3 * np.frombuffer(profile.data, '<f4')
        profile.data = array.array('B', millimetres.astype('<f4').tobytes())
        client.profiles.publish(profile)
    state = client.until_counted(malformed=22, profiles=20)
    for text in (state['message'], client.call('take_sample').message):
        assert 'the last 16 profiles cannot be used; the last reason: ' in text
        assert 'set profile.unit to mm' in text
    client.send(client.profiles, (sphere_profile(START + 4 * NS + i) for i in range(1000)), 1000)
    client.until(lambda: 'cannot be used' not in client.state()['message'], 'that was long ago')


def test_what_came_before_the_samples_were_cleared_tells_no_duration(client, node):
    def send(stamp: int) -> None:
        x = np.tile(np.linspace(-0.03, 0.03, 300), 2)
        client.profiles.publish(cloud_message(
            cloud({'x': x, 'z': np.full(600, 0.2)}, XZ, 8, height=2), stamp))

    send(START)  # two profiles, of which none says when it was taken
    send(START + NS // 20)
    client.until_counted(profiles=2)
    assert client.call('clear_samples').success
    send(START + 2 * NS // 20)
    send(START + 3 * NS // 20)
    client.until_counted(profiles=4)
    stand_still(client, START + NS)
    client.until_counted(profiles=24, poses=20)


def test_a_clock_that_is_set_back_takes_nothing_that_is_not(client, node):
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
    assert 'the clock of the poses was set back by 6' in state['warnings']
    assert 'older than those before' not in state['message']
    answer = client.call('take_sample')
    assert answer.success and answer.message.startswith('sample 2 taken: '), answer.message


def test_a_stop_is_judged_while_the_robot_stands(client, node):
    stand_still(client, START, 1.1)
    client.until(lambda: client.state()['samples'] == '1', 'the stop is a sample')
    stand_still(client, START + 22 * NS // 20)  # it stays: no second one
    stand_still(client, START + 3 * NS, 0.2, x=0.1)
    client.profiles.publish(sphere_profile(0))  # without a stamp: it gets the time of receipt
    assert client.until_counted(profiles=47, poses=46)['warnings'] == ''
    assert client.call('remove_last_sample').message.startswith('removed sample 1, the last one')
    assert client.state()['samples'] == '0'


def test_parameters_that_change_hold_at_once_or_are_refused(client, node):
    assert set_parameter(client, 'limits.residual', 0.002).successful
    assert set_parameter(client, 'target.radius', 1).successful, 'an int where a float is meant'
    assert set_parameter(client, 'target.radius', 0.04).successful
    assert set_parameter(client, 'noise.robot_class', 'calibrated').successful
    client.until(lambda: parameter(client, 'noise.robot_smooth') == 5e-5, 'a dump shows it')
    for name, value, reason in (
            ('limits.residual', 3.0, 'Max: 1.0'),
            ('noise.sensor', 'loud', "noise.sensor is 'loud', expected a number from 1e-09"),
            ('profile_topic', 'a b', '"a b" cannot name a topic'),
            ('profile_topic', '/flange_pose', 'each needs its own'),
            ('joint_topic', '/profile', 'each needs its own'),
            ('record.note', None, 'record.note cannot be deleted: set it to a value'),
            ('samples.exclude', None, 'samples.exclude cannot be deleted'),
            ('page.port', 1234, 'read-only parameter: page.port')):
        result = set_parameter(client, name, value)
        assert (result.successful, reason in result.reason) == (False, True), result.reason
    stand_still(client, START)
    client.until_counted(profiles=20, poses=20)
    assert client.call('take_sample').success
    assert 'no sample 99 to exclude' in set_parameter(client, 'samples.exclude', [1, 99]).reason
    for topic in ('profile_topic', 'joint_topic'):
        assert 'clear_samples first' in set_parameter(client, topic, '/other').reason
    assert set_parameter(client, 'sampling.min_points', 5000).successful
    client.until(lambda: client.state()['samples'] == '0', 'the sample is extracted again')
    assert 'clear_samples first' in set_parameter(client, 'pose_topic', '/other').reason
    assert set_parameter(client, 'sampling.min_points', 20).successful
    client.until(lambda: client.state()['samples'] == '1', 'the sample is back')


@pytest.mark.thorough
def test_topics_change_while_it_runs_and_a_wrong_type_is_reported(client, node):
    robot = client.node.create_publisher(PoseStamped, '/robot/pose', BEST_EFFORT)
    client.node.create_publisher(PointStamped, '/scan', RELIABLE)
    cause = 'sensor_msgs/msg/PointCloud2 is on /profile: set profile_topic'
    assert set_parameter(client, 'pose_topic', '/robot/pose').successful
    assert set_parameter(client, 'profile_topic', '/other').successful
    client.until(lambda: '/other has no publisher' in client.state()['message'], 'it says so')
    assert set_parameter(client, 'profile_topic', '/scan').successful
    client.until(lambda: robot.get_subscription_count()
                 and not client.profiles.get_subscription_count(), 'it hears others')
    client.until(lambda: 'with best effort' in client.state()['message'], 'why none comes')
    before = client.state()['poses']
    client.send(robot, [pose_message(START + i) for i in range(5)], rate=20)
    client.until(lambda: client.state()['poses'] != before, 'a pose is counted')
    client.node.destroy_publisher(robot)
    robot = client.node.create_publisher(PoseStamped, '/robot/pose', RELIABLE)
    client.until(lambda: [info.qos_profile.reliability for info in
                          client.node.get_subscriptions_info_by_topic('/robot/pose')]
                 == [RELIABLE.reliability], 'it hears as reliably as the driver now sends')
    client.until(lambda: cause in client.state()['message'], 'it says what is there')
    assert all(cause in client.call(service).message
               for service in ('take_sample', 'compute_calibration'))
    assert set_parameter(client, 'pose_topic', '/flange_pose').successful
    assert set_parameter(client, 'profile_topic', '/profile').successful
    client.until_heard()
    times = count(1)

    def taken() -> bool:
        k = next(times)  # again: what is sent before both know is lost; a pose counts once
        stand_still(client, START + 2 * k * NS, x=0.1 * k)
        return bool(client.call('take_sample').success)

    client.until(taken, 'a sample is taken')


@pytest.mark.thorough
def test_every_request_that_waits_is_answered(tmp_path, client):
    with running_node(tmp_path):
        client.connect()
        save = client.node.create_client(Trigger, '/handeye/save_calibration',
                                         qos_profile=QoSProfile(depth=5000))
        client.until(save.service_is_ready, 'save_calibration is there')
        answers = [save.call_async(Trigger.Request()) for _ in range(1500)]
        client.until(lambda: all(answer.done() for answer in answers), 'all are answered')
