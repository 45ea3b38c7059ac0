#!/usr/bin/env python3
"""
The node for hours: memory, losses, and how soon services answer.

usage: python bench/soak.py [--minutes 60] [--rate 1000]

Publishes profiles and the poses of a robot that stops each 4 s, and calls one service after the
other (take, compute, save, set a parameter, leave a sample out, remove, clear each 120 s), twice a
second; none waits for the solves, which go on beside them; browsers come to the page and go.
Publisher, caller and node are processes of their own; a further one on each processor tells when
that stood still (a virtual one is taken away at times) or ran something else: it sleeps for 5 ms
at a time, at the priority of the node, and notes where it woke up 20 ms late. Another writes 4 kB
twice a second, and notes how long the disk took. The publisher shares 32 MB with who listens.
Prints each minute what came, the load of the machine, the resident memory of the node and of its
other processes, and the slowest answer of each service so far; in the end what was lost, what the
node says that it left out, the memory and its slope (1 sigma) after the first 10 minutes, or the
first half, and how long the answers took: as they came, and without the times at which a processor
stood still. Needs ROS, on a domain of its own (ROS_DOMAIN_ID).

With `nice -n -10` before it all of these go before other work, also where Linux lets priorities
count within a session only (sched_autogroup).
"""
from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, ExitStack, suppress
import os
from pathlib import Path
import runpy
import socket
import subprocess
import sys
import tempfile
import time
from typing import Any, NoReturn

import numpy as np
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from scipy.stats import linregress
from std_srvs.srv import Trigger

LIVE = runpy.run_path(str(Path(__file__).with_name('live.py')))
CLEAR = 120.0  # s from one new session to the next
ASIDE = 'compute_calibration'  # whose answer is not waited for
SERVICES = ('take_sample', 'remove_last_sample', 'save_calibration', 'clear_samples', ASIDE)
TURNS = (*('take_sample', ASIDE, 'save_calibration', 'set_parameters') * 3,
         'remove_last_sample')  # so that samples gather
PAUSE = 0.5  # s between two calls
CYCLE = 4.0  # s from stop to stop
WARM = 600.0  # s until the slope of the memory counts, half of the time at most
AGREED = 0.1  # s in which a service is to answer
# Of the publisher: by default 34 profiles fit into what Fast DDS shares, and where the machine
# stands still for longer than these take, the publisher overwrites the oldest.
SHARED = """<?xml version="1.0" encoding="UTF-8"?>
<profiles xmlns="http://www.eprosima.com">
  <transport_descriptors>
    <transport_descriptor>
      <transport_id>shared</transport_id><type>SHM</type><segment_size>33554432</segment_size>
    </transport_descriptor>
    <transport_descriptor><transport_id>udp</transport_id><type>UDPv4</type></transport_descriptor>
  </transport_descriptors>
  <participant profile_name="driver" is_default_profile="true"><rtps>
    <userTransports>
      <transport_id>shared</transport_id><transport_id>udp</transport_id>
    </userTransports>
    <useBuiltinTransports>false</useBuiltinTransports>
  </rtps></participant>
</profiles>
"""
PULSE, LATE = 5e-3, 20e-3  # s between two looks at the clock; more than this between is told
PULSING = f"""
import os, sys, time
os.sched_setaffinity(0, [int(sys.argv[1])])
before = time.monotonic()
while True:
    time.sleep({PULSE})
    now = time.monotonic()
    if now - before > {PULSE + LATE}:
        print(before + {PULSE}, now, flush=True)
    before = now
"""


SYNCING = """
import os, sys, time
while True:
    with open(sys.argv[1], 'wb') as stream:
        stream.write(bytes(4096))
        stream.flush()
        before = time.monotonic()
        os.fsync(stream.fileno())
        print(before, time.monotonic(), flush=True)
    time.sleep(0.5)
"""


class User:
    """Calls one service after the other; calls: begin and end (s) of all by the name."""

    def __init__(self) -> None:
        """Join."""
        self._node = Node('user')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._calls, self._cleared = 0, time.monotonic()
        self._aside: tuple[float, Any] | None = None
        self.calls: dict[str, list[tuple[float, float]]] = defaultdict(list)
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
        """Call the next service, and wait for its answer; a solve goes on beside."""
        name = self._next()
        if name == ASIDE:
            self._aside = self._aside or self._asked(ASIDE)
            name = self._next()
        begin, future = self._asked(name)
        while not future.done():
            self._spin(1.0)
            assert time.monotonic() < begin + 60.0, f'{name} does not answer'
        self._answered(name, begin, future)

    def rest(self, seconds: float) -> None:
        """Take the answers that come for some time."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._spin(left)

    def _spin(self, seconds: float) -> None:
        self._executor.spin_once(timeout_sec=seconds)
        if self._aside and self._aside[1].done():
            self._answered(ASIDE, *self._aside)
            self._aside = None

    def _asked(self, name: str) -> tuple[float, Any]:
        """Return when a service was asked, and what will have its answer."""
        request: Any = Trigger.Request()
        if name == 'set_parameters':
            request = SetParameters.Request(parameters=[self._setting()])
        return time.monotonic(), self._clients[name].call_async(request)

    def _answered(self, name: str, begin: float, future: Any) -> None:
        self.calls[name].append((begin, time.monotonic()))
        self.succeeded[name] += getattr(future.result(), 'success', True)

    def _next(self) -> str:
        """Return the service whose turn it is."""
        self._calls += 1
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


def others_of(pid: int) -> dict[int, float]:
    """Return the resident memory (MB) of the processes that a process has started, by their id."""
    found = {}
    for file in Path(f'/proc/{pid}/task').glob('*/children'):
        with suppress(OSError):  # a thread, or a process, that has ended since
            found |= {int(child): LIVE['usage'](int(child))[1]
                      for child in file.read_text().split()}
    return found


def free_port() -> int:
    """Return a port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        return int(probe.getsockname()[1])


@contextmanager
def pulse(folder: str) -> Iterator[Callable[[], np.ndarray]]:
    """Run what tells when a processor stood still; give what returns these times (n, 2)."""
    with ExitStack() as stack:
        pulses = [stack.enter_context(reporting(PULSING, str(cpu), Path(folder) / f'pulse{cpu}'))
                  for cpu in os.sched_getaffinity(0)]
        yield lambda: merged(np.concatenate([times() for times in pulses]))


@contextmanager
def reporting(script: str, argument: str, log: Path) -> Iterator[Callable[[], np.ndarray]]:
    """Run a script that prints times; give what returns them (n, 2)."""
    with log.open('w') as stream, subprocess.Popen([sys.executable, '-c', script, argument],
                                                   stdout=stream) as process:
        try:
            yield lambda: np.array(log.read_text().split(), dtype=float).reshape(-1, 2)
        finally:
            process.kill()


def merged(times: np.ndarray) -> np.ndarray:
    """Return times (n, 2) as times (m, 2) that do not overlap."""
    found: list[list[float]] = []
    for begin, end in sorted(times.tolist()):
        if found and begin <= found[-1][1]:
            found[-1][1] = max(found[-1][1], end)
        else:
            found.append([begin, end])
    return np.array(found).reshape(-1, 2)


def without(calls: np.ndarray, still: np.ndarray) -> np.ndarray:
    """Return how long calls (n, 2) took, without the times (m, 2) the machine stood still."""
    begin, end = (np.maximum.outer, np.minimum.outer)
    shared = np.clip(end(calls[:, 1], still[:, 1]) - begin(calls[:, 0], still[:, 0]), 0.0, None)
    return np.asarray(np.diff(calls, axis=1)[:, 0] - shared.sum(axis=1))


def report(user: User, still: np.ndarray, synced: np.ndarray,
           memory: list[tuple[float, float, float]], minutes: float) -> None:
    """Print what has come of it."""
    late = np.array([m for m in memory if m[0] > min(WARM, 30 * minutes)])
    for column, name in ((1, 'node'), (2, 'its other processes')):
        found = linregress(late[:, 0] / 3600, late[:, column])
        low, middle, high = np.quantile(late[:, column], (0.05, 0.5, 0.95))
        print(f'{name}: {middle:.0f} MB (5 to 95 %: {low:.0f} to {high:.0f}), slope '
              f'{found.slope:.1f} +- {found.stderr:.1f} MB/h')
    took = np.diff(still, axis=1)
    print(f'a processor stood still, or ran other work, {len(still)} times for more than '
          f'{LATE:.2f} s, {took.sum():.1f} s in all, {took.max(initial=0.0):.2f} s at most')
    took = np.diff(synced, axis=1)
    print(f'4 kB of another process were synced in {np.median(took):.4f} s (median), 99 % within '
          f'{np.quantile(took, 0.99):.3f} s, slowest {took.max():.3f} s')
    for name, spans in sorted(user.calls.items()):
        calls = np.array(spans)
        for title, seconds in (('', np.diff(calls, axis=1)[:, 0]),
                               (', without these', without(calls, still))):
            middle, most = np.quantile(seconds, (0.5, 0.99))
            print(f'{name}{title}: {len(calls)} calls, {user.succeeded[name]} granted, median '
                  f'{middle:.3f} s, 99 % within {most:.3f} s, slowest {seconds.max():.3f} s, '
                  f'{(seconds > AGREED).sum()} over {AGREED} s')


def soak(minutes: float, rate: float) -> None:
    """Run, and print what happens."""
    watcher, begin = LIVE['Watcher'](), time.monotonic()
    user, memory, port = User(), [], free_port()
    with (tempfile.TemporaryDirectory() as folder, pulse(folder) as still,
          reporting(SYNCING, f'{folder}/synced', Path(folder) / 'synced.log') as synced,
          LIVE['listener']('node', folder, f'page.port:={port}') as (node, log)):
        user.wait()
        shared = Path(folder) / 'shared.xml'
        shared.write_text(SHARED)
        driver = subprocess.Popen(
            [sys.executable, LIVE['HERE'], '--publish', str(rate), '--seconds', str(60 * minutes),
             '--stops', '--cycle', str(CYCLE)], stdout=subprocess.PIPE, text=True,
            env={'FASTRTPS_DEFAULT_PROFILES_FILE': str(shared), **os.environ})
        output, started = 1, set[int]()
        while driver.poll() is None and node.poll() is None:
            watcher.wait(0.02, False)
            user.rest(PAUSE)
            try:
                user.call()
            except AssertionError as error:
                ended(f'{error}; the node: {node.poll()}', driver, log)
            look(port)
            now = time.monotonic() - begin
            _, resident = LIVE['usage'](node.pid)
            others = others_of(node.pid)
            if len(started) > 1 and others.keys() - started:
                print(f'a process was started again at {now:.0f} s; the node said:\n'
                      f'{log.read_text()[-2000:]}', flush=True)
            started |= others.keys()
            memory.append((now, resident, sum(others.values())))
            if now > 60 * output:
                output += 1
                slowest = ', '.join(f'{name} {np.diff(spans).max():.2f} s'
                                    for name, spans in user.calls.items())
                print(f'{now / 60:5.1f} min: load {os.getloadavg()[0]:.0f}, {watcher.count()} '
                      f'profiles, {resident:.0f} and {memory[-1][2]:.0f} MB; slowest {slowest}',
                      flush=True)
        if node.poll() is not None:
            ended(f'the node ended with {node.returncode}', driver, log)
        watcher.wait(4.0, False)
        sent = int(driver.stdout.read())
        print(f'{sent} profiles sent, {sent - watcher.count()} lost; {watcher.notes}')
        report(user, still(), synced(), memory, minutes)


def ended(why: str, driver: subprocess.Popen[str], log: Path) -> NoReturn:
    """Tell why it ends before its time, and what the node said last."""
    driver.kill()
    sys.exit(f'{why}\n{log.read_text()[-2000:]}')


def before_others() -> None:
    """Let the priority of this process count beside other sessions."""
    with suppress(OSError):
        os.setsid()
    with suppress(OSError):
        Path('/proc/self/autogroup').write_text(str(os.nice(0)))


def main() -> None:
    """Run the soak."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--minutes', type=float, default=60.0)
    parser.add_argument('--rate', type=float, default=1000.0)
    options = parser.parse_args()
    before_others()
    soak(options.minutes, options.rate)


if __name__ == '__main__':
    main()
