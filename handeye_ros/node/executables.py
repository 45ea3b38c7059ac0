# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
How all executables of the node start and end: arguments, signals, exit codes.

Slow imports are inside the functions, so that Ctrl-C ends an executable cleanly from the start.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import takewhile
import os
import signal
import sys
import traceback
from typing import Any

from handeye_ros.errors import ERROR_MARK, HandeyeError, InputError

SHUTDOWN_TIMEOUT = 1.0  # s until what runs is left alone
SPIN_TIMEOUT = 0.2  # s until a signal is seen


def non_ros_arguments() -> list[str]:
    """Return the arguments of the executable, which come before those for ROS."""
    return list(takewhile(lambda word: word != '--ros-args', sys.argv[1:]))


def spin(make: Callable[[], Any], threads: int = 1,
         stop: Callable[[Any], None] = lambda node: None) -> None:
    """
    Run the node that make() returns until Ctrl-C or SIGTERM, then stop(node).

    threads: of the executor; with several, an exception of a callback is in the log alone.
    Raises InputError if ROS does not start, or a topic cannot be used, and KeyboardInterrupt for a
    signal while the node is made.
    """
    from rclpy._rclpy_pybind11 import InvalidHandle, RCLError  # rclpy has them there alone
    from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
    with ros():
        runner = MultiThreadedExecutor(threads) if threads > 1 else SingleThreadedExecutor()
        try:
            node = make()
        except RCLError as error:
            reason = ' '.join(str(error).split())[:120]
            raise InputError(f'the node cannot use its topics ({reason}): check pose_topic and '
                             'profile_topic; each needs its own') from error
        try:
            runner.add_node(node)
            while True:
                try:
                    with suppress(InvalidHandle):  # of an entity that another thread destroyed
                        # with a timeout: a signal does not wake the executor
                        runner.spin_once(timeout_sec=SPIN_TIMEOUT)
                except Exception:
                    if threads == 1 or not node.context.ok():
                        raise
                    # the node that calibrates, and what it holds, must go on
                    node.get_logger().error(traceback.format_exc())
        except KeyboardInterrupt:
            set_signal_handler(lambda *_: os._exit(0))  # who asks again waits no longer
            stop(node)
            runner.shutdown(SHUTDOWN_TIMEOUT)
            node.destroy_node()


def run_for_exit_code(run: Callable[..., None], *args: Any) -> int:
    """Call a function until it ends, or Ctrl-C or SIGTERM; return the exit code, print errors."""
    try:
        run(*args)
    except (HandeyeError, OSError) as error:  # such as a folder that cannot be read
        print(f'{ERROR_MARK}{error}', file=sys.stderr)
        return error.exit_code if isinstance(error, HandeyeError) else InputError.exit_code
    except KeyboardInterrupt:
        pass
    return 0


@contextmanager
def ros() -> Iterator[None]:
    """
    Start rclpy and shut it down in the end; Ctrl-C and SIGTERM raise KeyboardInterrupt.

    Raises InputError for arguments and parameter files that ROS cannot read.
    """
    import rclpy
    from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
    from rclpy.signals import SignalHandlerOptions
    if not any(os.environ.get(name) for name in ('ROS_LOG_DIR', 'ROS_HOME', 'HOME')):
        raise InputError('ROS does not start: it has no place for its logs, as none of '
                         'ROS_LOG_DIR, ROS_HOME and HOME is set; set one of them')
    set_signal_handler(signal.default_int_handler)
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except UnknownROSArgsError as error:
        raise InputError(f'ROS does not start: it does not understand {error}') from error
    except RCLError as error:
        # without positions in the source of rcl
        text = str(error).removeprefix('failed to initialize rcl: ').split(', at /', 1)[0]
        raise InputError(f'ROS does not start: {text}') from error
    try:
        yield
    finally:
        rclpy.try_shutdown()


def set_signal_handler(handler: Callable[[int, Any], Any]) -> None:
    """Set the handler of Ctrl-C and SIGTERM."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)
