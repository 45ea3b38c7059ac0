"""Common to the executables: starting rclpy, and exit codes."""
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
import os
import signal
import sys
from typing import Any

from handeye_ros.errors import HandeyeError, InputError
import rclpy
from rclpy._rclpy_pybind11 import InvalidHandle, RCLError  # rclpy has them there alone
from rclpy.callback_groups import CallbackGroup
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions

__all__ = ['exit_code', 'InvalidHandle', 'offer', 'RCLError', 'ros', 'spin', 'UNSENDABLE']

REQUESTS = QoSProfile(depth=1000)  # may wait for a solve; by default ROS keeps only ten
UNSENDABLE = (RCLError, InvalidHandle)


def exit_code(run: Callable[[], None]) -> int:
    """Run to the end, or to Ctrl-C or SIGTERM; print the sentence of a HandeyeError."""
    try:
        run()
    except HandeyeError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    return 0


@contextmanager
def ros(args: Sequence[str] | None = None, *, interruptible: bool = False) -> Iterator[None]:
    """
    Start rclpy and shut it down in the end.

    args: those of the command line (None: sys.argv). interruptible: Ctrl-C and SIGTERM raise
    KeyboardInterrupt, for a main thread that does not spin. Raises InputError for arguments
    and parameter files that ROS cannot read.

    """
    if not any(os.environ.get(name) for name in ('ROS_LOG_DIR', 'ROS_HOME', 'HOME')):
        raise InputError('ROS does not start: it has no place for its logs, as none of '
                         'ROS_LOG_DIR, ROS_HOME and HOME is set; set one of them')
    options = SignalHandlerOptions.NO if interruptible else SignalHandlerOptions.ALL
    try:
        rclpy.init(args=None if args is None else list(args), signal_handler_options=options)
    except RCLError as error:
        # without positions in the source of rcl
        text = str(error).removeprefix('failed to initialize rcl: ').split(', at /', 1)[0]
        raise InputError(f'ROS does not start: {text}') from error
    if interruptible:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        with suppress(RCLError):  # a signal has shut it down meanwhile
            rclpy.try_shutdown()


def spin(executor: Executor) -> None:
    """
    Spin until ROS is shut down.

    Without the loop, an entity that another thread destroys meanwhile would end the executor.
    """
    while rclpy.ok():
        try:
            return executor.spin()
        except InvalidHandle:
            pass  # the next spin does not wait for it


def offer(node: Node, kind: Any, name: str, callback: Any, group: CallbackGroup) -> None:
    """Create a service of a node; an unsent response is reported in the log."""
    service = node.create_service(kind, f'~/{name}', callback, callback_group=group,
                                  qos_profile=REQUESTS)
    send = service.send_response

    def respond(response: Any, header: Any) -> None:
        try:
            send(response, header)
        except UNSENDABLE as error:
            if rclpy.ok():
                node.get_logger().warning(f'the answer of ~/{name} could not be sent: {error}')

    service.send_response = respond
