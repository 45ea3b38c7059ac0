"""
The command `handeye`: one module per verb.

A verb reads its arguments, calls one function of the library and prints what it returns.
"""
import os
import sys

OFFERED = ('main',)


def main() -> None:
    """Run the console script `handeye`; ends the process with its exit code."""
    # matrices are small: more threads only wait for each other, which takes a busy machine's time
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    from handeye_ros.cli.verbs import app
    # an answer must not be lost to a terminal that lacks a letter of it
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, 'reconfigure'):
            stream.reconfigure(errors='replace')
    app(prog_name='handeye')
