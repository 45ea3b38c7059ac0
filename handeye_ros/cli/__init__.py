# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The command `handeye`.

Verbs of answers are in solve.py, of what is done with one in measure.py, of recordings in
recordings.py. A verb reads its arguments, calls what computes, and prints or writes what that
returns.
"""
import atexit
import gc
from importlib import import_module
import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typer import Typer


def command() -> 'Typer':
    """Return the command; importing a module adds its verbs."""
    from handeye_ros.cli.common import app
    for group in ('solve', 'measure', 'recordings'):  # as help lists them
        import_module(f'handeye_ros.cli.{group}')
    return app


def main() -> None:
    """Run the console script `handeye`; ends the process with its exit code."""
    # small matrices: more threads only wait for each other and load the machine
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    # a terminal without some character must not lose the answer
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, 'reconfigure'):
            stream.reconfigure(errors='replace')
    # reading and solving leave no garbage in cycles, and what is alive at the end needs no search
    # either: both take a tenth of the time of a short verb
    gc.disable()
    atexit.register(gc.freeze)
    command()(prog_name='handeye')
