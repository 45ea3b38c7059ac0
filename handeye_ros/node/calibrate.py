# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Runs the node handeye: `ros2 run handeye_ros calibrate`.

It takes samples of the target as the robot moves, and computes and saves the calibration on
request. All settings are ROS parameters and follow --ros-args:

  calibrate --ros-args --params-file config/plate.yaml -p session:=last

`ros2 param list /handeye` and `ros2 param describe /handeye KEY` explain them while it runs.
"""
# Slow imports are inside the function, so that Ctrl-C ends it cleanly from the start.
from __future__ import annotations

import argparse
import os
import sys
from typing import NoReturn

from handeye_ros.node.executables import (
    non_ros_arguments,
    run_for_exit_code,
    set_signal_handler,
    spin,
)

EXECUTOR_THREADS = 6  # of the executor: three groups of services, two timers, the parameters
SWITCH_INTERVAL = 1e-3  # s until Python switches threads: one service call takes a dozen switches


def main() -> NoReturn:
    """Run the executable `calibrate`, and end the process with its exit code."""
    # an exception in the import of an extension module would be lost
    set_signal_handler(lambda *_: os._exit(0))
    # small matrices: more threads would slow down the streams
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    argparse.ArgumentParser(
        'calibrate', 'calibrate [-h] [--ros-args -p KEY:=VALUE --params-file FILE ...]', __doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter).parse_args(non_ros_arguments())
    sys.setswitchinterval(SWITCH_INTERVAL)
    from handeye_ros.node.node import HandeyeNode
    # it publishes nothing more while it ends, and what computes ends with it
    code = run_for_exit_code(spin, HandeyeNode, EXECUTOR_THREADS,
                             lambda node: node.outputs.close())
    sys.stderr.flush()
    # Python waits for all threads, of which one may wait for a solve; what was acknowledged is on
    # the disk
    os._exit(code)


if __name__ == '__main__':
    main()
