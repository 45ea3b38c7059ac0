#!/usr/bin/env python3
"""
Draws the pictures of docs/tutorial.md from the recording bags/plate, as the report shows them.

usage: .venv/bin/python tools/draw_tutorial.py [FOLDER]

The scene is a screenshot of the report: it needs chromium (apt install chromium).
"""
from __future__ import annotations

from pathlib import Path
import shutil
import subprocess
import sys
import tempfile

from handeye_ros import config as configs
from handeye_ros import pipeline
from handeye_ros.bags.bag import read
from handeye_ros.results import exports, figures, pages
from handeye_ros.results.evidence import Evidence

ROOT = Path(__file__).parents[1]
STOP = 5  # shown as an example


def main() -> None:
    """Write the pictures."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / 'docs' / 'figures')
    config = configs.load(ROOT / 'config' / 'plate.yaml')
    recording = read(ROOT / 'bags' / 'plate', config)
    found = pipeline.evidence(recording.profiles, recording.poses, config)
    used = [look for look in found.looks if look.used]
    with figures.style():
        for name, text in (('profile', figures.profile(used[STOP])),
                           ('coverage', figures.coverage(used)),
                           ('residuals', figures.residuals(used))):
            (folder / f'tutorial_{name}.svg').write_text(text, encoding='utf-8')
    screenshot(found, folder / 'tutorial_report.png')


def screenshot(found: Evidence, path: Path) -> None:
    """Write a picture of the top of the report."""
    assert found.calibration
    chromium = shutil.which('chromium')
    if not chromium:
        sys.exit('no chromium: the picture of the report stays as it was')
    with tempfile.TemporaryDirectory() as place:
        file = pages.write(found.calibration, found, Path(place) / exports.REPORT)
        text = file.read_text(encoding='utf-8')
        # the scene first, so that it is in sight
        file.write_text(text.replace('<style>', '<style>section{display:none}'
                                     'section:has(canvas){display:block}'), encoding='utf-8')
        subprocess.run([chromium, '--headless=new', '--no-sandbox', '--disable-gpu',
                        '--hide-scrollbars', '--window-size=900,860', f'--screenshot={path}',
                        file.as_uri()], check=True, stderr=subprocess.DEVNULL)


if __name__ == '__main__':
    main()
