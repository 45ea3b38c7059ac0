# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Two processes for long computations, each with a thread of the node that waits for it.

Python runs one thread at a time: solves and the evaluation of stops would slow down streams and
services. A process is started when it is first needed, and again after it has ended.
"""
from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from typing import Any, TypeVar

from handeye_ros.errors import HandeyeError

PROCESS_COUNT = 2  # a stop is evaluated while the calibration is computed
NICE_VALUE = 5  # nice value of the processes: the streams come first
MALLOC_TRIM = getattr(ctypes.CDLL(None), 'malloc_trim', None)  # of glibc alone

Result = TypeVar('Result')


class PoolEndedError(HandeyeError):
    """The process that computes ended before it had an answer."""

    def __init__(self) -> None:
        super().__init__('the process that computes ended before it had an answer (killed, or out '
                         'of memory?): call the service again, or ~/compute_calibration')


class Pool:
    """
    Runs functions of modules in other processes; one that is killed disturbs no other.

    Each thread has an executor with one process, as the end of a process breaks its executor.
    """

    def __init__(self) -> None:
        """Start no process yet."""
        # a node that ends at once leaves the semaphores of its processes to Python's tracker: it
        # removes them, and nobody needs to hear of it
        sys.warnoptions.append('ignore::UserWarning:multiprocessing.resource_tracker')
        self._own = threading.local()  # each thread sees its own `executor`
        self._threads = ThreadPoolExecutor(PROCESS_COUNT, 'pool', self._use_new_process)

    def _use_new_process(self) -> None:
        """Give this thread a process of its own, which starts with its first call."""
        self._own.executor = ProcessPoolExecutor(
            1, multiprocessing.get_context('spawn'), _initialise_process)

    def start(self) -> None:
        """Start the processes; what they compute with is imported by the first call of each."""
        for _ in range(PROCESS_COUNT):
            self.submit(trim_memory)

    def submit(self, function: Callable[..., Result], *args: Any) -> Future[Result]:
        """
        Return the future of a call, which the next process makes that is free.

        If that is killed, another one tries; the future raises PoolEndedError if it is killed too.
        """
        return self._threads.submit(self._call, function, args)

    def _call(self, function: Callable[..., Result], args: tuple[Any, ...]) -> Result:
        for _ in range(2):
            try:
                return self._own.executor.submit(call_and_trim, function, args).result()
            except BrokenProcessPool:
                self._use_new_process()
        raise PoolEndedError


def _initialise_process() -> None:
    """Let the process end with the node, even if that is killed, and leave Ctrl-C to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICE_VALUE)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent:
        parent.join()
    os._exit(0)


def call_and_trim(function: Callable[..., Result], args: tuple[Any, ...]) -> Result:
    """Return what a function returns, without the memory that it needed."""
    try:
        return function(*args)
    finally:
        trim_memory()


def trim_memory() -> None:
    """
    Return freed memory to the system, if the C library can (glibc); takes milliseconds.

    A stop has thousands of messages, a few of which are kept. Without this the freed memory
    between them would stay with the process and grow from stop to stop.
    """
    if MALLOC_TRIM is not None:
        MALLOC_TRIM(0)
