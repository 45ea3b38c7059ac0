#!/usr/bin/env python3
"""
The node for hours: memory, losses, and how soon services answer.

usage: python bench/soak.py [--minutes 60] [--rate 1000]

Publishes profiles and the poses of a robot that stops each 4 s, and calls one service after the
other (take, remove, compute, save, set a parameter, leave a sample out, clear each 120 s)
meanwhile, while browsers come to the page and go. Prints each minute what came, the load of the
machine, the resident memory of the node and of its second process, and the slowest answer of
each service so far; in the end what was lost, what the node says that it left out, the slope of
the memory behind the first half of the time, and how long the answers took. Needs ROS, on a
domain of its own (ROS_DOMAIN_ID).
"""
from __future__ import annotations

import argparse
from collections import Counter, defaultdict
import os
from pathlib import Path
import runpy
import socket
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
CLEAR = 120.0  # s from one new session to the next
SERVICES = ('take_sample', 'remove_last_sample', 'compute_calibration', 'save_calibration',
            'clear_samples')
# so that samples gather
TURNS = (*('take_sample', 'compute_calibration', 'save_calibration', 'set_parameters') * 3,
         'remove_last_sample')
PAUSE = 0.5  # s between two calls
CYCLE = 4.0  # s from stop to stop


class User:
    """Calls one service after the other; took: seconds of all calls by the name."""

    def __init__(self, watcher: Any) -> None:
        """Join."""
        self._watcher = watcher
        self._node = Node('user')
        self._calls, self._cleared = 0, time.monotonic()
        self.took: dict[str, list[float]] = defaultdict(list)
        self.succeeded: Counter[str] = Counter()
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
        self._calls += 1
        name = self._next()
        request: Any = Trigger.Request()
        if name == 'set_parameters':
            request = SetParameters.Request(parameters=[self._setting()])
        begin = time.monotonic()
        future = self._clients[name].call_async(request)
        rclpy.spin_until_future_complete(self._node, future, timeout_sec=60.0)
        assert future.done(), f'{name} does not answer'
        self.took[name].append(time.monotonic() - begin)
        self.succeeded[name] += getattr(future.result(), 'success', True)

    def _next(self) -> str:
        """Return the service whose turn it is."""
        if time.monotonic() - self._cleared > CLEAR:
            self._cleared = time.monotonic()
            return 'clear_samples'
        return TURNS[self._calls % len(TURNS)]

    def _setting(self) -> Parameter:
        """Return what is set next: a limit, or which sample is left out."""
        value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE,
                               double_value=0.005 + 1e-6 * self._calls)
        if self._calls % 2:
            return Parameter(name='limits.translation', value=value)
        left_out = [1] if self._calls % 4 else [2]
        return Parameter(name='samples.exclude', value=ParameterValue(
            type=ParameterType.PARAMETER_INTEGER_ARRAY, integer_array_value=left_out))


def look(port: int) -> None:
    """Open the page as a browser does, take what it tells first, and go."""
    with socket.create_connection(('127.0.0.1', port), timeout=30) as line:
        line.sendall(f'GET /events HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n'.encode())
        assert b'200 OK' in line.recv(1000)


def second_of(pid: int) -> float:
    """Return the resident memory (MB) of the processes that a process has started."""
    children = Path(f'/proc/{pid}/task').glob('*/children')
    return sum(LIVE['usage'](int(child))[1] for file in children
               for child in file.read_text().split())


def free_port() -> int:
    """Return a port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        return int(probe.getsockname()[1])


def soak(minutes: float, rate: float) -> None:
    """Run, and print what happens."""
    watcher, begin = LIVE['Watcher'](), time.monotonic()
    user, memory, port = User(watcher), [], free_port()
    with (tempfile.TemporaryDirectory() as folder,
          LIVE['listener']('node', folder, f'page.port:={port}') as (node, _)):
        user.wait()
        driver = subprocess.Popen(
            [sys.executable, LIVE['HERE'], '--publish', str(rate), '--seconds', str(60 * minutes),
             '--stops', '--cycle', str(CYCLE)], stdout=subprocess.PIPE, text=True)
        told = 1
        while driver.poll() is None and node.poll() is None:
            watcher.wait(PAUSE, False)
            user.call()
            look(port)
            now = time.monotonic() - begin
            _, resident = LIVE['usage'](node.pid)
            memory.append((now, resident, second_of(node.pid)))
            if now > 60 * told:
                told += 1
                slowest = ', '.join(f'{name} {max(t):.2f} s' for name, t in user.took.items())
                print(f'{now / 60:5.1f} min: load {os.getloadavg()[0]:.0f}, {watcher.count()} '
                      f'profiles, {resident:.0f} and {memory[-1][2]:.0f} MB; slowest {slowest}',
                      flush=True)
        watcher.wait(4.0, False)
        sent = int(driver.stdout.read())
        print(f'{sent} profiles sent, {sent - watcher.count()} lost; {watcher.notes}')
    late = np.array([m for m in memory if m[0] > 30 * minutes])
    for column, name in ((1, 'node'), (2, 'second process')):
        slope = np.polyfit(late[:, 0] / 3600, late[:, column], 1)[0]
        print(f'{name}: {late[0, column]:.0f} MB to {late[-1, column]:.0f} MB, slope '
              f'{slope:.1f} MB/h')
    for name, took in sorted(user.took.items()):
        middle, most = np.quantile(took, (0.5, 0.95))
        print(f'{name}: {len(took)} calls, {user.succeeded[name]} granted, median {middle:.3f} s, '
              f'95 % within {most:.3f} s, slowest {max(took):.3f} s')


def main() -> None:
    """Run the soak."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--minutes', type=float, default=60.0)
    parser.add_argument('--rate', type=float, default=1000.0)
    options = parser.parse_args()
    soak(options.minutes, options.rate)


if __name__ == '__main__':
    main()
