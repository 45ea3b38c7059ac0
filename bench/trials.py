# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Trials of a Monte-Carlo bench on one process, on local workers of Dask, or on a cluster."""
from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import partial
import sys
from typing import TypeVar

import cloudpickle
from handeye_ros.batch import client_of

CHUNK = 4  # trials of one task: fewer cost more of Dask, more leave workers idle at the end
J, R = TypeVar('J'), TypeVar('R')

cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers need not have bench/


def add_option(parser: argparse.ArgumentParser) -> None:
    """Add the option that says where trials run."""
    parser.add_argument('--workers', default='1', help='how many processes of this machine, or '
                        'the address of a Dask scheduler; results do not depend on it')


def results(function: Callable[[J], R], jobs: Sequence[J], workers: str) -> Iterator[R]:
    """Yield what a function returns of each job, in their order; each draws by its own seed."""
    if workers == '1':
        yield from map(function, jobs)
        return
    number = int(workers) if workers.isdigit() else 0
    with client_of('local' if number else workers, workers=number) as client:
        chunks = [jobs[k:k + CHUNK] for k in range(0, len(jobs), CHUNK)]
        futures = deque(client.map(partial(_each, function), chunks, pure=False))
        while futures:
            yield from futures.popleft().result()


def _each(function: Callable[[J], R], jobs: Sequence[J]) -> list[R]:
    return [function(job) for job in jobs]
