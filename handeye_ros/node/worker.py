# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The thread that makes the changes of a session, one after the other; see live.py."""
from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, TypeVar

from handeye_ros.errors import DataError, InputError, sentence_and_log
from handeye_ros.node.pool import Pool, trim_memory

Result = TypeVar('Result')


class Worker:
    """
    Calls what others ask of it, what is due, and what takes over the result of a long computation.

    running_jobs: the names of the long computations
    trouble: why the last work failed, a sentence; '' where it did not
    """

    def __init__(self, pool: Pool, do_due_work: Callable[[], object],
                 publish_changes: Callable[[], object]) -> None:
        """
        Start no thread yet.

        pool: where long computations run; do_due_work: does one piece of what is due, and calls
        `schedule` for the next; publish_changes: called after each piece of it, also if it failed,
        after what `call` says, and after a long computation.
        """
        self.running_jobs: list[str] = []
        self.trouble = ''
        self._pool, self._thread = pool, ThreadPoolExecutor(1, 'worker')
        self._do_due_work, self._publish_changes = do_due_work, publish_changes
        self._is_started = self._is_scheduled = False

    def start(self) -> None:
        """Begin with what is due."""
        self._is_started = True
        self.schedule()

    def call(self, function: Callable[[], Result], then_publish: bool = False) -> Result:
        """
        Return the result of a function that the worker calls, or raise its exception.

        then_publish: whether its changes are published before; else the work that is due next
        publishes them, after a stop that waits.
        """
        try:
            called = self._thread.submit(function)
            if then_publish:
                self._thread.submit(self._publish).result()
            return called.result()
        finally:
            self.schedule()

    def schedule(self) -> None:
        """Look for what is due; racing threads may do so twice: no harm."""
        if self._is_started and not self._is_scheduled:
            self._is_scheduled = True
            self._thread.submit(self._call_and_publish, self._look_for_work)

    def _look_for_work(self) -> None:
        self._is_scheduled = False
        self._do_due_work()
        trim_memory()

    def _call_and_publish(self, function: Callable[..., object], *args: Any) -> None:
        """Call a function and publish the changes; a failure is a trouble until one succeeds."""
        try:
            function(*args)
            self.trouble = ''
        except Exception as error:  # noqa: BLE001 - the thread must go on
            self.trouble = sentence_and_log('the work on the samples', error)
        self._publish()

    def _publish(self) -> None:
        try:
            self._publish_changes()
        except Exception as error:  # noqa: BLE001 - the thread must go on
            self.trouble = sentence_and_log('publishing', error)

    def run_job(self, name: str, accept: Callable[[Any], Result],
                function: Callable[..., Any], *args: Any) -> Future[Result]:
        """
        Begin a long computation in another process; return the future of what accept returns.

        name: a description of it, '' for what nobody has asked for: then a refusal too is a
        trouble, as are always other errors; accept: called by the worker with the result.
        """
        outcome = Future[Result]()

        def finish(job: Future[Any]) -> None:
            self.running_jobs.remove(name)
            try:
                result = accept(job.result())
                self._publish()
                outcome.set_result(result)
            except Exception as error:
                outcome.set_exception(error)
                if not (name and isinstance(error, DataError | InputError)):
                    raise
            self.schedule()  # samples or settings may have changed meanwhile

        self.running_jobs.append(name)
        self._pool.submit(function, *args).add_done_callback(
            partial(self._thread.submit, self._call_and_publish, finish))
        return outcome
