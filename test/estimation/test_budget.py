# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What each cause contributes to the reported covariance, and how it is shown."""
from __future__ import annotations

from pathlib import Path
import re

from cells import cell
from command import handeye, ROOT
from handeye_ros import pipeline
from handeye_ros.config import Config, with_values
from handeye_ros.estimation.covariance import budget
from handeye_ros.simulate import settings
import numpy as np
import pytest


@pytest.mark.parametrize('target', ['plate', 'sphere'])
def test_the_parts_add_up_to_what_is_reported(target: str) -> None:
    made = cell(target, 0)
    config = with_values(Config(), settings(made.scenario), target)
    solution = pipeline.answer(made.samples, (), config).consensus()
    found = budget(solution)
    assert found.samples == len(made.samples)
    assert {'sensor, white', 'poses, white', 'robot_smooth', 'best fit'} <= {
        term.name for term in found.terms}
    for size in ('translation', 'rotation', 'mapped'):
        squares = sum(getattr(term, size) ** 2 for term in found.terms)
        assert squares == pytest.approx(getattr(found.total, size) ** 2, rel=1e-6)
    std = np.sqrt(np.diag(solution.reported)[:3])
    assert found.total.translation == pytest.approx(np.sqrt((std ** 2).mean()))


def test_the_command_line_shows_it(tmp_path: Path) -> None:
    shown = handeye('solve', ROOT / 'bags/plate', '--config', ROOT / 'config/plate.yaml',
                    '--budget', '--out', tmp_path, cwd=tmp_path)
    assert shown.returncode == 0, shown.stderr
    table = shown.stdout[shown.stdout.index('1 sigma by cause'):]
    shares = [float(share) for share in re.findall(r'([\d.]+) %', table)]
    assert shares[-1] == 100.0 and sum(shares[:-1]) == pytest.approx(100.0, abs=1.0)
    assert '18 samples' in table
    uncertain = handeye('solve', ROOT / 'bags/plate', '--config', ROOT / 'config/plate.yaml',
                        '--set', 'limits.translation=1e-6', '--budget', '--out', tmp_path / 'none',
                        cwd=tmp_path)
    assert uncertain.returncode == 3 and 'limits.translation' in uncertain.stderr
    assert '1 sigma by cause' in uncertain.stdout and not (tmp_path / 'none').exists()
    refused = handeye('solve', ROOT / 'bags/tracker', '--config', ROOT / 'config/tracker.yaml',
                      '--budget', '--out', tmp_path, cwd=tmp_path)
    assert refused.returncode == 2 and '--budget' in refused.stderr
