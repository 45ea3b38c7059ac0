# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Processes for long computations.

Python runs one thread at a time: solves and the evaluation of stops would slow down streams and
services. A process is started when it is first needed, and again after it has ended.
"""
from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from typing import Any, TypeVar

from handeye_ros.errors import HandeyeError

Result = TypeVar('Result')
ENDED = (BrokenProcessPool, CancelledError)
TRIM = getattr(ctypes.CDLL(None), 'malloc_trim', None)  # of glibc alone


class PoolEndedError(HandeyeError):
    """The process that computes ended before it had an answer."""

    def __init__(self) -> None:
        super().__init__('the process that computes ended before it had an answer (killed, or out '
                         'of memory?): call the service again; this restarts the process')


class Pool:
    """Runs functions of modules in another process, one after the other."""

    def __init__(self, nice: int = 0) -> None:
        """Start no process yet; nice: increment of its nice value."""
        # a node that ends at once leaves the semaphores of its processes to Python's tracker: it
        # removes them, and nobody needs to hear of it
        sys.warnoptions.append('ignore::UserWarning:multiprocessing.resource_tracker')
        self._nice, self._stopped = nice, False
        self._executor = self._new()

    def _new(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, multiprocessing.get_context('spawn'), _begin, (self._nice,))

    def submit(self, function: Callable[..., Result], *args: Any) -> Future[Result]:
        """
        Return the future of a call; if the process ends, its exception is one of ENDED.

        Raises PoolEndedError after stop().
        """
        if self._stopped:
            raise PoolEndedError
        try:
            return self._executor.submit(_call, function, args)
        except BrokenProcessPool:
            self._executor = self._new()
            return self._executor.submit(_call, function, args)

    def run(self, function: Callable[..., Result], *args: Any) -> Result:
        """Return the result of a function; raises its exceptions, and PoolEndedError."""
        try:
            return self.submit(function, *args).result()
        except ENDED as error:
            raise PoolEndedError from error

    def stop(self) -> None:
        """End the process, also a running function."""
        self._stopped = True
        self._executor.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.kill()


def _begin(nice: int) -> None:
    """Prepare the process: it ends with the node, even if that is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in the terminal is for the node
    os.nice(nice)
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
    if TRIM is not None:
        TRIM(0)
