# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Two processes for long computations.

Python runs one thread at a time: solves and the evaluation of stops would slow down streams and
services. A process is started when it is first needed, and again after it has ended.
"""
from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import (
    CancelledError,
    Future,
    ProcessPoolExecutor,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
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
                         'of memory?): call the service again; this restarts the process')


def result_or_ended(future: Future[Result]) -> Result:
    """Return the result of a future; raises its exception, PoolEndedError if there is none."""
    try:
        return future.result()
    except (BrokenProcessPool, CancelledError) as error:
        raise PoolEndedError from error


class Pool:
    """Runs functions of modules in other processes."""

    def __init__(self) -> None:
        """Start no process yet."""
        # a node that ends at once leaves the semaphores of its processes to Python's tracker: it
        # removes them, and nobody needs to hear of it
        sys.warnoptions.append('ignore::UserWarning:multiprocessing.resource_tracker')
        self._executor = self._new()

    def _new(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(PROCESS_COUNT, multiprocessing.get_context('spawn'), _begin)

    def start(self) -> None:
        """Let the processes finish their imports before they are needed."""
        for _ in range(PROCESS_COUNT):
            self.submit(trim_memory)

    def submit(self, function: Callable[..., Result], *args: Any) -> Future[Result]:
        """Return the future of a call, for result_or_ended."""
        try:
            return self._executor.submit(_call, function, args)
        except BrokenProcessPool:
            self._executor = self._new()
            return self._executor.submit(_call, function, args)

    def run(self, function: Callable[..., Result], *args: Any) -> Result:
        """
        Return the result of a function; raises its exceptions.

        If the process is killed, another one tries; raises PoolEndedError if it is killed too.
        """
        with suppress(PoolEndedError):
            return result_or_ended(self.submit(function, *args))
        return result_or_ended(self.submit(function, *args))


def _begin() -> None:
    """Prepare the process: it ends with the node, even if that is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in the terminal is for the node
    os.nice(NICE_VALUE)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent:
        parent.join()
    os._exit(0)


def _call(function: Callable[..., Result], args: tuple[Any, ...]) -> Result:
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
