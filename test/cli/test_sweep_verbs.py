# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A recording of a sweep on the command line: answer, report, and whether it still holds."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import re

from command import handeye
from handeye_ros.data import TimeOffset
from handeye_ros.results.calibration_file import read_calibration, write_calibration
import pytest

BAG = str(Path(__file__).parents[2] / 'bags' / 'plate_sweep')


@pytest.mark.thorough
def test_a_sweep_is_solved_reported_and_checked(tmp_path: Path) -> None:
    config = str(Path(BAG).parents[1] / 'config' / 'plate.yaml')
    run = handeye('solve', BAG, '--config', config, '--set', 'sampling.mode=moving', '--out', 'a',
                  cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert 'time offset' in run.stdout
    run = handeye('report', 'a/calibration.yaml', '--out', 'a.html', cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert 'over the speed of the flange' in (tmp_path / 'a.html').read_text()
    solved = read_calibration(tmp_path / 'a' / 'calibration.yaml')
    assert solved.time_offset is not None
    run = handeye('check', BAG, '--against', 'a/calibration.yaml', cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert 'UNCHANGED' in run.stdout and 'time offset is as it was' in run.stdout
    other = TimeOffset(solved.time_offset.value + 5e-3, solved.time_offset.std)
    write_calibration(replace(solved, time_offset=other), tmp_path / 'b.yaml')
    run = handeye('check', BAG, '--against', 'b.yaml', cwd=tmp_path)
    assert run.returncode == 1, run.stderr
    changed = re.search('CLOCK: .* time offset has changed by (-[0-9.]+) ms', run.stdout)
    assert changed and float(changed[1]) == pytest.approx(-5, abs=0.2)
