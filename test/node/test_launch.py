# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The launch files: what they start is run as launch_ros runs it.

`launch` and `launch_ros` are on no package index, so stand-ins take their place, for these calls:
LaunchDescription(entities); DeclareLaunchArgument(name, default_value=, description=);
OpaqueFunction(function=); LaunchConfiguration(name).perform(context);
PathJoinSubstitution(parts) and FindPackageShare(package) as default values; Node(package=,
executable=, name=, namespace=, output=, arguments=, parameters=, remappings=). A node's command
is put together in the order of launch_ros/actions/node.py: arguments, then behind --ros-args
name, namespace, parameter files (a dict becomes one, for all nodes; a file that is missing is
left out, with a warning) and remappings.
"""
from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
import subprocess
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

from calibrations import CALIBRATION
from command import ROOT
from handeye_ros import config
from handeye_ros.errors import InputError
from handeye_ros.results.calibration_file import write_calibration
import pytest
import yaml


def argument(name: str, *, default_value: Any = None, description: str) -> SimpleNamespace:
    return SimpleNamespace(**locals())


def launched(*, package: str, executable: str, name: str, output: str = 'log', namespace: str = '',
             arguments: Sequence[str] = (), parameters: Sequence[Any] = (),
             remappings: Sequence[tuple[str, str]] = ()) -> SimpleNamespace:
    return SimpleNamespace(**locals())


class LaunchConfiguration(str):

    def perform(self, context: dict[str, str]) -> str:
        return context[self]


class FindPackageShare(str):

    def perform(self, context: dict[str, str]) -> str:
        assert self == 'handeye_ros'
        return str(ROOT)


class PathJoin(list):

    def perform(self, context: dict[str, str]) -> str:
        return '/'.join(p.perform(context) if hasattr(p, 'perform') else p for p in self)


STAND_INS = {
    'launch': {'LaunchDescription': list, 'LaunchContext': dict},
    'launch.actions': {'DeclareLaunchArgument': argument,
                       'OpaqueFunction': lambda function: function},
    'launch.substitutions': {'LaunchConfiguration': LaunchConfiguration,
                             'PathJoinSubstitution': PathJoin},
    'launch_ros': {}, 'launch_ros.actions': {'Node': launched},
    'launch_ros.substitutions': {'FindPackageShare': FindPackageShare}}


def described(file: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[list[Any], Any]:
    """Return the arguments that a launch file declares, and its function."""
    for name, values in STAND_INS.items():
        module = ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)
    names: dict[str, Any] = {}
    exec(compile(file.read_text(), file, 'exec'), names)
    *arguments, function = names['generate_launch_description']()
    return arguments, function


def nodes(launch_file: str, monkeypatch: pytest.MonkeyPatch, **arguments_given: str) -> list[Any]:
    """Return what a launch file starts with these arguments."""
    arguments, function = described(ROOT / 'launch' / f'{launch_file}.launch.py', monkeypatch)
    values = {a.name: a.default_value for a in arguments}
    assert arguments_given.keys() <= values.keys()
    context = {key: value if isinstance(value, str) else value.perform({})
               for key, value in (values | arguments_given).items() if value is not None}
    return function(context)


def command(node: Any, folder: Path) -> list[str]:
    """Return the command of a node of this package."""
    assert node.package == 'handeye_ros'
    words = [sys.executable, '-m', f'handeye_ros.node.{node.executable}',
             *node.arguments, '--ros-args', '-r', f'__node:={node.name}']
    if node.namespace:
        words += ['-r', f'__ns:=/{node.namespace.lstrip("/")}']
    for number, parameters in enumerate(node.parameters):
        file = parameters
        if isinstance(parameters, dict):
            file = folder / f'launch_params_{node.name}_{number}.yaml'
            file.write_text(yaml.safe_dump({'/**': {'ros__parameters': parameters}}))
        if Path(file).is_file():
            words += ['--params-file', str(file)]
    for before, after in node.remappings:
        words += ['-r', f'{before}:={after}']
    return words


def test_what_is_set_here_wins_over_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    (node,) = nodes('calibrate', monkeypatch)
    time, file = node.parameters
    # a file that says what the time is comes last, and wins
    assert time == {'use_sim_time': False} and (node.name, node.executable) == (
        'handeye', 'calibrate')
    assert config.load(Path(file)).target.type == 'plate'
    arguments, _ = described(ROOT / 'launch' / 'calibrate.launch.py', monkeypatch)
    ports = {a.name: '8080' for a in arguments if a.name not in ('config', 'rviz_layout')}
    others = {'base_frame': 'base_link', 'rviz': '0', 'use_sim_time': '1'}
    node = nodes('calibrate', monkeypatch, **ports | others)[0]
    assert node.parameters[-1].keys() <= {p.key for p in config.parameters()}
    assert node.parameters[-1]['robot_base_frame'] == 'base_link'
    times = [nodes('calibrate', monkeypatch, use_sim_time=text)[0].parameters[0]
             for text in ('True', '1', 'true', '0')]
    assert [time['use_sim_time'] for time in times] == [True, True, True, False]


@pytest.mark.parametrize(('name', 'value', 'expected'), [
    ('rviz', 'yes', 'expected true or false'), ('use_sim_time', 'no', 'expected true or false'),
    ('page', 'abc', 'expected the number of a port')])
def test_other_words_are_refused(name: str, value: str, expected: str,
                                 monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=f'{name} is "{value}", {expected}'):
        nodes('calibrate', monkeypatch, **{name: value})


@pytest.mark.parametrize('name', ['config', 'rviz_layout'])
def test_a_file_that_is_missing_is_refused(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    words = f'{name} is "cell_4.yml", and there is no file /.*cell_4.yml'
    with pytest.raises(InputError, match=words):
        nodes('calibrate', monkeypatch, rviz='true', **{name: 'cell_4.yml'})


def test_a_file_may_be_relative(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'cell.yaml').write_text((ROOT / 'config' / 'line.yaml').read_text())
    (node,) = nodes('calibrate', monkeypatch, config='cell.yaml')
    monkeypatch.chdir('/')  # the node may start elsewhere
    words = command(node, tmp_path)
    assert str(tmp_path / 'cell.yaml') in words


@pytest.mark.ros
def test_launch_itself_ends_without_the_file(tmp_path: Path) -> None:
    pytest.importorskip('ros2launch', reason='needs ros2 launch')
    found = subprocess.run(
        ['ros2', 'launch', str(ROOT / 'launch' / 'calibrate.launch.py'), 'config:=cell_4.yml'],
        cwd=tmp_path, text=True, timeout=60, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert found.returncode and 'config is "cell_4.yml", and there is no file' in found.stdout


@pytest.mark.thorough
@pytest.mark.ros
def test_a_bag_is_solved_in_a_namespace(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip('rclpy', reason='needs rclpy')
    from command import running
    from ros_helpers import Client
    from std_srvs.srv import Trigger
    started = nodes('calibrate', monkeypatch, namespace='cell', name='mine', rate='20',
                    bag=str(ROOT / 'bags' / 'plate'), output_dir=str(tmp_path / 'saved'))
    with ExitStack() as stack:
        node, replay = (stack.enter_context(running(
            command(each, tmp_path), cwd=ROOT, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL)) for each in started)
        client = Client()
        stack.callback(client.close)

        def call(service: str) -> Any:
            asked = client.node.create_client(Trigger, f'/cell/handeye/{service}')
            client.until(asked.service_is_ready, f'{service} is there')
            future = asked.call_async(Trigger.Request())
            client.until(future.done, f'{service} answers')
            return future.result()

        client.until(lambda: replay.poll() is not None, 'the bag is over')
        answer = call('compute_calibration')
        assert answer.success, answer.message
        assert call('save_calibration').success
    assert (tmp_path / 'saved' / 'mine' / 'calibration.yaml').is_file()


def heard(topic: str, kind: Any, started: Sequence[Any], folder: Path) -> Any:
    """Return the first message on a topic of the nodes of a launch file."""
    from command import running
    from ros_helpers import Client, LATCHED, RELIABLE
    messages: list[Any] = []
    with ExitStack() as stack:
        client = Client()
        stack.callback(client.close)
        client.node.create_subscription(kind, topic, messages.append,
                                        LATCHED if topic == '/tf_static' else RELIABLE)
        for each in started:
            stack.enter_context(running(command(each, folder), cwd=ROOT,
                                        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        client.until(lambda: messages, f'something comes on {topic}')
    return messages[0]


@pytest.mark.thorough
@pytest.mark.ros
def test_a_bag_is_scanned_in_a_namespace(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip('rclpy', reason='needs rclpy')
    from sensor_msgs.msg import PointCloud2
    write_calibration(CALIBRATION, tmp_path / 'calibration.yaml')
    started = nodes('scan', monkeypatch, calibration=str(tmp_path), namespace='cell', rate='3',
                    bag=str(ROOT / 'bags' / 'plate'), options='--std')
    points = heard('/cell/handeye_scan/points', PointCloud2, started, tmp_path)
    assert points.header.frame_id == 'base' and points.fields[-1].name == 'std'


@pytest.mark.thorough
@pytest.mark.ros
def test_saved_calibrations_are_published(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip('rclpy', reason='needs rclpy')
    message = pytest.importorskip('tf2_msgs.msg', reason='needs tf2_msgs').TFMessage
    (tmp_path / 'a folder').mkdir()
    write_calibration(CALIBRATION, tmp_path / 'a folder' / 'calibration.yaml')
    write_calibration(replace(CALIBRATION, child_frame='camera'), tmp_path / 'camera.yaml')
    files = f'"{tmp_path}/a folder" {tmp_path}/camera.yaml'
    started = nodes('publish', monkeypatch, calibrations=files, namespace='cell')
    transforms = heard('/tf_static', message, started, tmp_path).transforms
    assert {transform.child_frame_id for transform in transforms} == {'laser', 'camera'}
