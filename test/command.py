"""Runs the command line as a user does."""
from __future__ import annotations

from pathlib import Path
import subprocess
import sys

ROOT = Path(__file__).parents[1]
PLATE = ROOT / 'config' / 'plate.yaml'


def handeye(*arguments, cwd, before=''):
    """Run `handeye` in a folder; before: code that runs in its process first."""
    program = f'import sys; sys.path.insert(0, {str(ROOT)!r}); {before}\n' \
              'from handeye_ros.cli import main; main()'
    return subprocess.run([sys.executable, '-c', program, *map(str, arguments)], cwd=cwd,
                          capture_output=True, text=True, check=False)


def assert_refused(run, code, *words):
    """Check that a run ended with a sentence that holds the words, and without an answer."""
    assert run.returncode == code, run.stderr
    assert 'Traceback' not in run.stderr
    assert 1 <= len(run.stderr.splitlines()) <= 3, run.stderr
    assert run.stdout == ''
    for word in words:
        assert word in run.stderr
