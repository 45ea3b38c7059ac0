# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Calibrates from a bag through the node, as a user would: `make demo`.

Starts the node and the replay, each in its own process, calls the services to compute and save the
calibration, and shows the answer.
"""
from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time

from diagnostic_msgs.msg import DiagnosticArray
from handeye_ros import config as configuration
from handeye_ros.bags.storage import Reader
from handeye_ros.data import Calibration
from handeye_ros.errors import DataError, InputError, UnwritableError
from handeye_ros.node.executables import ros, run_for_exit_code
from handeye_ros.output import write_atomically
from handeye_ros.results import calibration_file, exports, printed, report
from handeye_ros.results.file_values import input_provenance
from handeye_ros.results.truth import errors_against, true_transform
from handeye_ros.review import solved_recording
import rclpy
from rclpy.node import Node
from rich.console import Console
from std_srvs.srv import Trigger

PATIENCE = 120.0  # s for an answer of the node


def demo(bag: Path, config: Path, out: Path, rate: float) -> None:
    """
    Calibrate from a bag over ROS; print the answer and leave out/calibration.yaml.

    A previous result in out is kept in its history; without an answer it stays in place. Raises
    InputError, or DataError when the node has no answer.

    """
    configuration.load(config)
    T_true, out = true_transform(bag), out.absolute()
    os.environ['ROS_DOMAIN_ID'] = str(20 + os.getpid() % 80)  # undisturbed by other nodes
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    with _scratch(out) as saved, ros():
        _through_the_node(bag, rate, out / 'node.log',
                          ['--params-file', str(config), '-p', f'output_dir:={saved}'])
        calibration = _with_bag(
            calibration_file.read_calibration(next(saved.glob('*/calibration.yaml'))), bag, out)
    written = exports.save_all(calibration, out, ())
    terminal = sys.stdout.isatty()
    Console(width=None if terminal else 160).print(printed.table(calibration))
    if T_true is not None:
        print(printed.error_sentence(errors_against(calibration.T_flange_sensor, T_true)))
    report_file = out / exports.REPORT_FILE
    write_atomically(report_file, report.html(calibration, solved_recording(calibration, bag)))
    print(f'{written}\nwrote {report_file}: open it in a browser')


def _with_bag(calibration: Calibration, bag: Path, out: Path) -> Calibration:
    """Return the calibration with the replayed bag in place of the node's session."""
    provenance = dict(calibration.provenance)
    topics = [item for item in provenance['inputs'] if 'topic' in item]
    reader = Reader(bag)
    list(reader.messages())
    provenance['inputs'] = [*topics, *map(input_provenance, reader.files)]
    provenance['config'] = {**provenance['config'], 'output_dir': str(out)}
    return replace(calibration, provenance=provenance)


def _through_the_node(bag: Path, rate: float, log: Path, options: Sequence[str]) -> None:
    """Start the node, replay the bag, compute and save."""
    with log.open('wb') as stream, _child('calibrate', ['--ros-args', *options], stream) as node:
        print(f'the node is running; its log: {log}', flush=True)
        client = Client(node, log)
        client.wait()
        with _child('replay', [str(bag), '--rate', str(rate)]) as replay:
            print(f'replaying {bag}, {rate:g} times as fast as recorded', flush=True)
            client.print_samples_until(lambda: replay.poll() is not None)
            if replay.returncode:
                raise InputError(f'the replay of {bag} failed')
        client.wait_until_all_is_taken()
        print('solving', flush=True)
        client.call('compute_calibration')
        client.call('save_calibration')


@contextmanager
def _scratch(out: Path) -> Iterator[Path]:
    """Give a temporary folder below out."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix='.', dir=out) as folder:
            yield Path(folder)
    except OSError as error:
        raise UnwritableError(error.filename or out, error) from error


@contextmanager
def _child(module: str, arguments: Sequence[str], log: object = None
           ) -> Iterator[subprocess.Popen[bytes]]:
    """Run a module of this package in a process that ends with the block."""
    command = [sys.executable, '-m', f'handeye_ros.node.{module}', *arguments]
    process = subprocess.Popen(command, stdout=log, stderr=log)  # type: ignore[call-overload]
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


class Client:
    """Client of the node in another process."""

    def __init__(self, process: subprocess.Popen[bytes], log: Path) -> None:
        """Listen to the node; log: what it prints."""
        self._process = process
        self._log = log
        self._node = Node('handeye_demo')
        self._diagnostics: list[dict[str, str]] = []
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    def wait(self) -> None:
        """Wait for the node; raises InputError with its own message if it ends instead."""
        client = self._node.create_client(Trigger, '/handeye/save_calibration')
        self._until(client.service_is_ready)

    def print_samples_until(self, condition: Callable[[], bool]) -> None:
        """Print the number of samples at each change until a condition holds."""
        last_count = ''
        while not condition():
            rclpy.spin_once(self._node, timeout_sec=0.1)
            count = self._diagnostics[-1].get('samples', '') if self._diagnostics else ''
            if count != last_count and count != '0':
                print(f'samples so far: {count}', flush=True)
                last_count = count

    def call(self, service: str) -> str:
        """Return the message of a service; raises DataError if it fails."""
        future = self._node.create_client(Trigger, f'/handeye/{service}').call_async(
            Trigger.Request())
        self._until(future.done)
        if not future.result().success:
            raise DataError(f'~/{service} was refused: {future.result().message}')
        return str(future.result().message)

    def wait_until_all_is_taken(self) -> None:
        """Wait until the node receives no further messages for a second."""
        self._diagnostics.clear()
        self._until(lambda: len(self._diagnostics) > 1
                    and _counts(self._diagnostics[-1]) == _counts(self._diagnostics[-2]))

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        self._diagnostics.append({pair.key: pair.value for status in msg.status
                                  for pair in status.values})

    def _until(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            if self._process.poll() is not None or time.monotonic() > end:
                lines = self._log.read_text(encoding='utf-8').splitlines()
                raise InputError('the node does not answer; the end of its log: '
                                 + (lines[-1] if lines else 'it says nothing'))
            rclpy.spin_once(self._node, timeout_sec=0.1)


def _counts(diagnostics: dict[str, str]) -> list[str]:
    return [diagnostics[key] for key in ('profiles', 'poses', 'malformed messages')]


def main() -> int:
    """Run the demo."""
    parser = argparse.ArgumentParser(prog='demo', description=__doc__)
    parser.add_argument('--bag', type=Path, required=True)
    parser.add_argument('--config', type=Path, required=True)
    parser.add_argument('--out', type=Path, required=True)
    parser.add_argument('--rate', type=float, default=4.0, help='speed; 1: as recorded')
    options = parser.parse_args()
    return run_for_exit_code(lambda: demo(options.bag, options.config, options.out, options.rate))


if __name__ == '__main__':
    sys.exit(main())
