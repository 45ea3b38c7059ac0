# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Nodes in processes of their own, and a client that waits for what can be seen of them."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
import re
import subprocess
import sys
import time
from typing import Any

from command import PATIENCE, ROOT, run_python, running
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from handeye_ros.node.streams import TFMessage
import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import GetParameters, SetParameters
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_clouds import cloud
from sensor_msgs.msg import PointCloud2, PointField
from std_srvs.srv import SetBool, Trigger

RELIABLE = QoSProfile(depth=2000)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
ROW = re.compile(r'^\| (subscribes|publishes|service) \| `([^`]+)`[^|]*\| ([\w/]+)[^|]*\|', re.M)
XZ = {'x': (0, 7), 'z': (4, 7)}


@contextmanager
def running_node(tmp_path: Path, *arguments: str, program: Path | None = None
                 ) -> Iterator[subprocess.Popen[str]]:
    """
    Run the node; what it prints goes to node.log, what it saves below tmp_path.

    program: a changed node, to run in its place.
    """
    command = [sys.executable, *([program] if program else ['-m', 'handeye_ros.node.calibrate']),
               '--ros-args', '-p', f'output_dir:={tmp_path}', *arguments]
    with ((tmp_path / 'node.log').open('w') as log,
          running(command, cwd=ROOT, stdout=log, stderr=log, text=True) as process):
        yield process


def run_module(module: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a module of handeye_ros.node to its end."""
    return run_python('-m', f'handeye_ros.node.{module}', *arguments, timeout=PATIENCE)


def replay(bag: Path) -> None:
    """Publish a bag at ten times its speed, once all of its topics have a subscriber."""
    run = run_module('replay', str(bag), '--rate', '10', '--timeout', str(PATIENCE))
    assert (run.returncode, run.stderr) == (0, '')


class Client:
    """A node in the process of the test."""

    def __init__(self) -> None:
        """Start; close ends it."""
        self._context = Context()
        rclpy.init(context=self._context)
        self.node = Node('client', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._told: list[dict[str, str]] = []
        self._before: dict[str, str] = {}
        self._services: dict[str, Any] = {}
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self.profiles = self.node.create_publisher(PointCloud2, '/profile', RELIABLE)
        self.poses = self.node.create_publisher(PoseStamped, '/flange_pose', RELIABLE)

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def until(self, condition: Callable[[], Any], what: str) -> None:
        """Spin until a condition holds; what: for the message if it never does."""
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, f'waited in vain until {what}'
            self._executor.spin_once(timeout_sec=0.01)

    def until_heard(self) -> None:
        """Wait until the profiles and poses of the client have a subscriber."""
        self.until(lambda: self.profiles.get_subscription_count()
                   and self.poses.get_subscription_count(), 'profiles and poses are heard')

    def connect(self) -> None:
        """Wait until the node hears the client and answers; counts are from now on."""
        self.until_heard()
        self._before = self.state()

    def send(self, publisher: Any, messages: Iterable[Any], rate: float) -> None:
        """Publish like a driver, so many messages a second: best effort takes no bursts."""
        begin = time.monotonic()
        for count, msg in enumerate(messages, 1):
            publisher.publish(msg)
            due = begin + count / rate
            self.until(lambda due=due: time.monotonic() >= due, 'time passes')

    def call(self, service: str, request: Any = None) -> Any:
        """Return the answer of a service of the node."""
        request = request or Trigger.Request()
        kind = SetBool if isinstance(request, SetBool.Request) else Trigger
        return self.request(kind, service, request)

    def request(self, kind: Any, service: str, request: Any) -> Any:
        if service not in self._services:
            self._services[service] = self.node.create_client(kind, f'/handeye/{service}')
        client = self._services[service]
        self.until(client.service_is_ready, f'{service} is there')
        future = client.call_async(request)
        self.until(future.done, f'{service} answers')
        return future.result()

    def state(self) -> dict[str, str]:
        """Return what the node says of itself from now on."""
        self._told.clear()
        self.until(lambda: self._told, 'the node publishes diagnostics')
        return self._told[-1]

    def until_counted(self, **counts: int) -> dict[str, str]:
        """Wait until the node has counted so many messages (malformed, profiles, poses)."""
        keys = {'malformed': 'malformed messages', 'profiles': 'profiles', 'poses': 'poses'}
        expected = {keys[name]: int(self._before.get(keys[name], 0)) + n
                    for name, n in counts.items()}
        self.until(lambda: self._told and all(
            int(self._told[-1][key]) == n for key, n in expected.items()),
            f'the node has counted {counts}')
        return self._told[-1]

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        report = {'level': max(status.level for status in msg.status),
                  'message': '; '.join(status.message for status in msg.status)}
        for status in msg.status:
            report |= {pair.key: pair.value for pair in status.values}
        self._told.append(report)


def cloud_message(source: Any, stamp: int = 0, frame_id: str = 'laser') -> PointCloud2:
    """Return the message of rclpy that is like one of ros_clouds.cloud."""
    msg = PointCloud2(height=source.height, width=source.width, point_step=source.point_step,
                      row_step=source.row_step, is_bigendian=source.is_bigendian,
                      data=source.data.tobytes())
    msg.fields = [PointField(**vars(field)) for field in source.fields]
    set_header(msg, stamp, frame_id)
    return msg


def pose_message(stamp: int, position: Any = (0.0, 0.0, 0.0),
                 orientation: Any = (0.0, 0.0, 0.0, 1.0), frame_id: str = 'base') -> PoseStamped:
    msg = PoseStamped()
    p, q = msg.pose.position, msg.pose.orientation
    p.x, p.y, p.z = map(float, position)
    q.x, q.y, q.z, q.w = map(float, orientation)
    set_header(msg, stamp, frame_id)
    return msg


def set_header(msg: Any, stamp: int, frame_id: str) -> None:
    msg.header.stamp.sec, msg.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
    msg.header.frame_id = frame_id


def sphere_profile(stamp: int) -> PointCloud2:
    """Return a profile across the middle of a sphere of 40 mm radius."""
    x = np.linspace(-0.03, 0.03, 300)
    return cloud_message(cloud({'x': x, 'z': 0.2 - np.sqrt(0.04**2 - x**2)}, XZ, 8), stamp)


def stand_still(client: Client, start: int, seconds: float = 1.0, x: float = 0.0) -> None:
    """
    Publish what the sensor of a robot that stands still sees, and its poses, 20 times a second.

    All profiles come first: they are larger, and a stop is looked at as its poses are read.
    """
    stamps = range(start, start + round(seconds * 1e9), 50_000_000)
    for stamp in stamps:
        client.profiles.publish(sphere_profile(stamp + 1))
    for stamp in stamps:
        client.poses.publish(pose_message(stamp, (x, 0.0, 0.0)))


def set_parameter(client: Client, name: str, value: Any) -> SetParametersResult:
    """Return whether a parameter of the node is set, and why not."""
    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
    return client.request(SetParameters, 'set_parameters', request).results[0]


def parameter(client: Client, name: str) -> Any:
    """Return the value of a parameter of the node, as ROS shows it."""
    value, = client.request(GetParameters, 'get_parameters',
                            GetParameters.Request(names=[name])).values
    return parameter_value_to_python(value)


def listed() -> set[tuple[str, str, str]]:
    """Return (what, full name, type) of the rows of the contract."""
    rows = ROW.findall((ROOT / 'docs' / 'contract.md').read_text(encoding='utf-8'))
    assert len(rows) > 10
    return {(what, '/handeye/' + name[2:] if name[0] == '~' else '/' + name.lstrip('/'), kind)
            for what, name, kind in rows if TFMessage or name != '/tf_static'}


def offered(client: Client) -> set[tuple[str, str, str]]:
    node = client.node
    queries = {'publishes': node.get_publisher_names_and_types_by_node,
               'subscribes': node.get_subscriber_names_and_types_by_node,
               'service': node.get_service_names_and_types_by_node}
    return {(what, name, kind) for what, ask in queries.items()
            for name, kinds in ask('handeye', '/') for kind in kinds}
