# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The command line and the core start and solve where ROS is not installed."""
from __future__ import annotations

from pathlib import Path
import subprocess
import sys

import pytest

pytestmark = pytest.mark.once

ROOT = Path(__file__).parents[1]


def run_without_ros(code: str) -> subprocess.CompletedProcess[str]:
    """Run code in a Python to which rclpy is not installed."""
    block = "import sys; sys.modules['rclpy'] = None; "
    return subprocess.run(
        [sys.executable, '-c', block + code], cwd=ROOT, capture_output=True, text=True,
        check=False)


def test_the_command_line_starts_without_ros() -> None:
    run = run_without_ros('from handeye_ros.cli import command; command()')
    assert run.returncode == 0, run.stderr


def test_solve_needs_no_ros(tmp_path: Path) -> None:
    arguments = ['handeye', 'solve', 'bags/plate', '--config', 'config/plate.yaml',
                 '--out', str(tmp_path)]
    run = run_without_ros(
        f'sys.argv = {arguments}; from handeye_ros.cli import main; main()')
    assert run.returncode == 0, run.stderr
    assert (tmp_path / 'calibration.yaml').exists()
