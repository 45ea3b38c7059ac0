# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The documentation builds into a site, and no link in it leads nowhere."""
from __future__ import annotations

from pathlib import Path
import subprocess
import sys

from command import ROOT
import pytest

pytest.importorskip('mkdocs', reason='needs mkdocs')

pytestmark = pytest.mark.once


def test_the_site_builds(tmp_path: Path) -> None:
    run = subprocess.run(
        [sys.executable, '-m', 'mkdocs', 'build', '--quiet', '--strict', '--site-dir',
         str(tmp_path)], cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
    pages = {path.stem for path in (ROOT / 'docs').glob('*.md')} - {'index'}
    assert all((tmp_path / page / 'index.html').is_file() for page in pages)
    assert 'start' in (tmp_path / 'index.html').read_text(encoding='utf-8')
