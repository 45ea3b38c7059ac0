#!/usr/bin/env python3
"""
The node for hours: memory, losses, and how soon services answer.

usage: python bench/soak.py [--minutes 60] [--rate 1000]

Publishes profiles and the poses of a robot that stops each 6 s, and calls one service after the
other (take, remove, compute, save, set a parameter) meanwhile. Prints each minute what came and
was lost, the resident memory and the slowest answer of each service; in the end the slope of the
memory behind the first fifth of the time. Needs ROS, on a domain of its own (ROS_DOMAIN_ID).
"""
from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path
import runpy
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.node import Node
from std_srvs.srv import Trigger

LIVE = runpy.run_path(str(Path(__file__).with_name('live.py')))
SERVICES = ('take_sample', 'remove_last_sample', 'compute_calibration', 'save_calibration')
PAUSE = 0.5  # s between two calls
CYCLE = 6.0  # s from stop to stop


class User:
    """Calls one service after the other; slowest: seconds by the name."""

    def __init__(self, watcher: Any) -> None:
        """Join."""
        self._watcher = watcher
        self._node = Node('user')
        self._calls = 0
        self.slowest: dict[str, float] = defaultdict(float)
        self._clients = {name: self._node.create_client(Trigger, f'/handeye/{name}')
                         for name in SERVICES}
        self._clients['set_parameters'] = self._node.create_client(
            SetParameters, '/handeye/set_parameters')

    def wait(self) -> None:
        """Wait until all services are there."""
        for client in self._clients.values():
            assert client.wait_for_service(60.0), f'{client.srv_name} is not there'

    def call(self) -> None:
        """Call the next service, and wait for its answer."""
        names = list(self._clients)
        name = names[self._calls % len(names)]
        self._calls += 1
        request: Any = Trigger.Request()
        if name == 'set_parameters':
            value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE,
                                   double_value=0.005 + 1e-6 * self._calls)
            request = SetParameters.Request(parameters=[Parameter(
                name='limits.translation', value=value)])
        begin = time.monotonic()
        future = self._clients[name].call_async(request)
        rclpy.spin_until_future_complete(self._node, future, timeout_sec=60.0)
        assert future.done(), f'{name} does not answer'
        self.slowest[name] = max(self.slowest[name], time.monotonic() - begin)


def soak(minutes: float, rate: float) -> None:
    """Run, and print what happens."""
    watcher, begin = LIVE['Watcher'](), time.monotonic()
    user, memory = User(watcher), []
    with tempfile.TemporaryDirectory() as folder, LIVE['listener']('node', folder) as (node, _):
        user.wait()
        driver = subprocess.Popen(
            [sys.executable, LIVE['HERE'], '--publish', str(rate), '--seconds', str(60 * minutes),
             '--stops', '--cycle', str(CYCLE)], stdout=subprocess.PIPE, text=True)
        told = 1
        while driver.poll() is None and node.poll() is None:
            watcher.wait(PAUSE, False)
            user.call()
            now = time.monotonic() - begin
            _, resident = LIVE['usage'](node.pid)
            memory.append((now, resident))
            if now > 60 * told:
                told += 1
                print(f'{now / 60:5.1f} min: {watcher.count()} profiles, {resident:.0f} MB; '
                      'slowest ' + ', '.join(f'{k} {v:.2f} s' for k, v in user.slowest.items()),
                      flush=True)
        watcher.wait(4.0, False)
        sent = int(driver.stdout.read())
        print(f'{sent} profiles sent, {sent - watcher.count()} lost')
    late = np.array([m for m in memory if m[0] > 12 * minutes])
    slope = np.polyfit(late[:, 0] / 3600, late[:, 1], 1)[0]
    print(f'memory {late[0, 1]:.0f} MB to {late[-1, 1]:.0f} MB, slope {slope:.1f} MB/h')


def main() -> None:
    """Run the soak."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--minutes', type=float, default=60.0)
    parser.add_argument('--rate', type=float, default=1000.0)
    options = parser.parse_args()
    soak(options.minutes, options.rate)


if __name__ == '__main__':
    main()
