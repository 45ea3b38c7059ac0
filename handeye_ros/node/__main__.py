"""
The executable `calibrate`: arguments, signals, exit codes.

Slow imports are inside the functions, so that Ctrl-C ends it cleanly from the start.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
import errno
import os
import signal
import sys
from typing import Any

THREADS = 8  # of the executor: one for each group of callbacks (services, timers, parameters)
SWITCH = 1e-3  # s until Python switches threads: one service call takes a dozen switches

USAGE = """\
usage: calibrate [--help] [--ros-args [-p KEY:=VALUE]... [--params-file FILE] [-r OLD:=NEW]...]

Runs the node handeye: takes samples of the target as the robot moves, and computes and saves the
calibration on request. All settings are ROS parameters and follow --ros-args:

  calibrate --ros-args --params-file config/plate.yaml -p session:=last

`ros2 param list /handeye` and `ros2 param describe /handeye KEY` explain them while it runs.
"""


def own_arguments(argv: Sequence[str]) -> list[str]:
    """Return the arguments outside of --ros-args ... [--]."""
    remaining, in_ros_arguments = [], False
    for argument in argv:
        if in_ros_arguments:
            in_ros_arguments = argument != '--'
        elif argument == '--ros-args':
            in_ros_arguments = True
        else:
            remaining.append(argument)
    return remaining


def refused(arguments: Sequence[str]) -> int | None:
    """Print the usage for --help and for unknown arguments; return the exit code, or None."""
    if not arguments:
        return None
    if arguments[0] in ('-h', '--help'):
        print(USAGE, end='')
        return 0
    print(f'error: unknown arguments: {" ".join(arguments)} (ROS arguments such as --params-file '
          f'and -p follow --ros-args)\n{USAGE}', end='', file=sys.stderr)
    return 2


def main() -> int:
    """Run the executable `calibrate`; return the exit code, 1 if output cannot be written."""
    code = 0
    sys.setswitchinterval(SWITCH)
    # small matrices: more threads would slow down the streams
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    with suppress(KeyboardInterrupt):
        try:
            code = _run()
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise
            code = 1
    return code if flushed() else code or 1


def _run() -> int:
    code = refused(own_arguments(sys.argv[1:]))
    if code is None:
        # an exception in the import of an extension module would be lost
        on_signals(lambda *_: os._exit(0))
        from handeye_ros.node.executable import exit_code
        from handeye_ros.node.node import HandeyeNode
        on_signals(signal.default_int_handler)
        code = exit_code(lambda: run(HandeyeNode))
    return code


def run(make: Callable[[], Any]) -> None:
    """Run the node that make() returns until Ctrl-C or SIGTERM."""
    from handeye_ros.node.errors import TopicsError
    from handeye_ros.node.executable import RCLError, ros, spin, UNSENDABLE
    import rclpy
    from rclpy.executors import MultiThreadedExecutor
    with ros():
        try:
            node = make()
        except UNSENDABLE as error:
            if not rclpy.ok():  # ended by a signal
                return
            raise TopicsError(str(error)) from error
        executor = MultiThreadedExecutor(THREADS)
        executor.add_node(node)
        try:
            spin(executor)
        except KeyboardInterrupt:
            pass
        except RCLError:
            if rclpy.ok():  # else ended by a signal
                raise
        finally:
            node.stop()
            executor.shutdown()
            node.destroy_node()
        if node.live.progress.text:
            # Python would wait for the thread that solves
            flushed()
            os._exit(0)


def on_signals(handler: Callable[[int, Any], Any]) -> None:
    """Set the handler of Ctrl-C and SIGTERM."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)


def flushed() -> bool:
    """Flush the output; return whether it could be written."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            with suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
            return False
    return True


if __name__ == '__main__':
    sys.exit(main())
