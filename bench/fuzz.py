#!/usr/bin/env python3
"""
Malformed messages and damaged files: no crash, no hang, no memory without bound.

usage: python bench/fuzz.py [--messages 1000000] [--files 100000] [--seconds S] [--seed 0]
                            [--only KIND ...]
       python bench/fuzz.py --guided [--seconds S]

Each case is made by its number and the seed alone, so a failure is found again. It must end in
an answer that holds what its type promises or in an error of this package, within 2 s, and the
process must stay below 1 GB. Prints for each kind the counts, how many were refused, and the
slowest. --guided: atheris leads the bytes of messages and mcap files by coverage (needs atheris).
"""
from __future__ import annotations

import argparse
from pathlib import Path
import resource
import sys
import tempfile
import time

from fuzzing.damage import Case
from fuzzing.files import FILES
from fuzzing.good import prepare
from fuzzing.messages import MESSAGES, SHARES
from handeye_ros.errors import HandeyeError
import numpy as np

SLOWEST = 2.0  # s
LARGEST = 1024.0  # MB


def attempt(case: Case, seed: int, number: int, folder: Path) -> tuple[bool, float]:
    """Return whether a case was refused, and its seconds; raises what is no refusal."""
    begin = time.process_time()
    try:
        case(np.random.default_rng([seed, number]), folder)
        refused = False
    except HandeyeError as error:
        refused = bool(str(error))
        assert refused
    return refused, time.process_time() - begin


def fuzz(name: str, case: Case, seed: int, count: int, seconds: float, folder: Path) -> int:
    """Run cases and tell of them; return how many failed."""
    refused, slowest, failed, done = 0, 0.0, 0, 0
    end = time.process_time() + seconds
    while done < count and time.process_time() < end:
        try:
            no, took = attempt(case, seed, done, folder)
            refused += no
            slowest = max(slowest, took)
            assert took < SLOWEST, f'it took {took:.1f} s'
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            failed += 1
            if failed <= 5:
                print(f'FAILED {name}, seed {seed}, number {done}: {error!r}', flush=True)
        done += 1
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f'{name:17} seed {seed}: {done:8} cases, {refused:8} refused, {failed} failed; slowest '
          f'{slowest:.3f} s, {memory:.0f} MB', flush=True)
    return failed + (memory > LARGEST)


def main() -> int:
    """Run all kinds; the exit code is 1 where one failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--messages', type=int, default=1_000_000)
    parser.add_argument('--files', type=int, default=100_000)
    parser.add_argument('--seconds', type=float, default=3600.0, help='of each kind, at most')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--only', nargs='+', choices=[*MESSAGES, *FILES], metavar='KIND',
                        default=[*MESSAGES, *FILES], help='the kinds to run, default: all')
    parser.add_argument('--guided', action='store_true')
    options = parser.parse_args()
    if options.guided:
        from fuzzing.guided import guided
        guided(options.seconds)
        return 0
    failed = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare(folder)
        for kind in options.only:
            count = (round(options.messages * SHARES[kind]) if kind in MESSAGES else
                     options.files // len(FILES))
            failed += fuzz(kind, (MESSAGES | FILES)[kind], options.seed, count, options.seconds,
                           folder)
    return bool(failed)


if __name__ == '__main__':
    sys.exit(main())
