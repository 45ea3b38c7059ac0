"""
The command `handeye`: every verb wraps one function of the library.

One file per group of verbs; importing it here makes its verbs known.
"""
import sys

from handeye_ros.cli import calibrate, check, measure, recordings, results, seam, session, verify
from handeye_ros.cli.app import app

__all__ = ['app', 'calibrate', 'check', 'main', 'measure', 'recordings', 'results', 'seam',
           'session', 'verify']


def main() -> None:
    """Run the console script `handeye`; ends the process with its exit code."""
    # an answer must not be lost to a terminal that lacks a letter of it
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, 'reconfigure'):
            stream.reconfigure(errors='replace')
    app(prog_name='handeye')
