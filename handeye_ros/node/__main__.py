# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Runs the node: `python -m handeye_ros.node`, which is `ros2 run handeye_ros calibrate`."""
import sys

from handeye_ros.node.main import main

if __name__ == '__main__':
    sys.exit(main())
