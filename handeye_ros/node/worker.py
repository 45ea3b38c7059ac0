"""
Worker processes for long computations, and the progress in words.

Solves and the evaluation of stops run in other processes: Python runs one thread at a time, so
they would slow down streams and services. A process is started when it is first needed.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
import ctypes
from dataclasses import replace
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import traceback
from typing import Any, TypeVar

from handeye_ros.config import Config
from handeye_ros.data import Reject, Sample
from handeye_ros.errors import HandeyeError
from handeye_ros.node.errors import WorkerEndedError
from handeye_ros.sampling.station_features import evenly
from handeye_ros.sampling.stops import judged, needed, Outcome, result_of, sample_of, Stop

Result = TypeVar('Result')
TRIM = getattr(ctypes.CDLL(None), 'malloc_trim', None)  # of glibc alone
COMMAND = (sys.executable, '-m', 'handeye_ros.node.worker')


class Runner:
    """Runs functions of modules in the calling process; see WorkerProcess."""

    def run(self, function: Callable[..., Result], *args: Any, urgent: bool = False) -> Result:
        """Return the result of a function; raises its exceptions."""
        return function(*args)

    def stop(self) -> None:
        """Stop, also a running function."""


class Buffers(list[bytes]):
    """A file for pickle as a list of buffers: one buffer of some MB would fragment the memory."""

    write = list.append


class WorkerProcess(Runner):
    """
    Runs functions in another process, one after the other; urgent ones first.

    Arguments, results and errors are pickled. The process ends with this one, even if this one is
    killed: it then reads the end of its stdin.
    """

    def __init__(self, nicer: int = 0) -> None:
        """Start no process yet; nicer: increment of its nice value."""
        self._command = (*COMMAND, str(nicer))
        self._process: subprocess.Popen[bytes] | None = None
        self._turns = threading.Condition()
        self._busy, self._urgent, self._stopped = False, 0, False
        self._suspended = False  # whether the process was suspended by a signal, and killed

    def run(self, function: Callable[..., Result], *args: Any, urgent: bool = False) -> Result:
        """Return the result of a function; raises its exceptions, and WorkerEndedError."""
        self._begin(urgent)
        try:
            return self._request(function, args)
        finally:
            with self._turns:
                self._busy = False
                self._turns.notify_all()

    def _begin(self, urgent: bool) -> None:
        with self._turns:
            self._urgent += urgent
            self._turns.wait_for(lambda: not self._busy and (urgent or not self._urgent))
            self._urgent -= urgent
            self._busy = True

    def _request(self, function: Callable[..., Result], args: tuple[Any, ...]) -> Result:
        request = Buffers()  # complete before it is sent: pickling may fail
        pickle.dump((function, args), request)
        process = self._running()
        assert process.stdin and process.stdout
        try:
            process.stdin.writelines(request)
            process.stdin.flush()
            result, error = pickle.load(process.stdout)
        except (EOFError, OSError, pickle.UnpicklingError) as end:
            process.kill()
            code = process.wait()
            raise WorkerEndedError(-signal.SIGSTOP if self._suspended else code) from end
        if error is not None:
            raise error
        return result

    def _running(self) -> subprocess.Popen[bytes]:
        """Return the process, started if necessary; raises WorkerEndedError."""
        with self._turns:
            if self._stopped:
                raise WorkerEndedError(0)
            if self._process is None or self._process.poll() is not None:
                # a separate process group: Ctrl-C in the terminal is for this process alone; the
                # same session: Linux compares nice values within a session only
                self._process = subprocess.Popen(self._command, stdin=subprocess.PIPE,
                                                 stdout=subprocess.PIPE, process_group=0)
                self._suspended = False
                threading.Thread(target=self._watch, args=(self._process,), daemon=True).start()
            return self._process

    def _watch(self, process: subprocess.Popen[bytes]) -> None:
        """Kill a suspended process (SIGSTOP), for which its callers would wait forever."""
        with suppress(ChildProcessError):  # it ended and was reaped
            change = os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
            if change and change.si_code == os.CLD_STOPPED:
                self._suspended = True
                process.kill()

    def stop(self) -> None:
        """Kill the process; waiting callers get a WorkerEndedError."""
        with self._turns:
            self._stopped = True
            if self._process is not None:
                self._process.kill()
                self._process.wait()


class Evaluator:
    """
    Evaluates stops with a runner; in this process if that of the runner has ended.

    trouble: why the last stop was evaluated in this process, '' if it was not.
    """

    def __init__(self, runner: Runner) -> None:
        self._runner = runner
        self.trouble = ''

    def begin(self) -> None:
        """Start the process, to finish its imports before the first stop."""
        threading.Thread(target=self._run, args=(evenly, (), 1), daemon=True).start()

    def stop(self) -> None:
        """End the process."""
        self._runner.stop()

    def result(self, stop: Stop, config: Config) -> Sample | Reject:
        """Return the sample of a stop, or the reject with the reason."""
        return self._run(result_of, needed(stop, config), config)

    def sample(self, stop: Stop, config: Config) -> Sample:
        """Return the sample of a stop; raises FeatureError with the reason."""
        return self._run(sample_of, needed(stop, config), config)

    def reevaluated(self, outcome: Outcome, config: Config) -> Outcome:
        """Return the outcome of the same stop with another configuration; not urgent."""
        bare = replace(outcome, result=Reject(outcome.result.stamp, ''))
        return replace(outcome, result=self._run(judged, bare, config, urgent=False).result)

    def _run(self, function: Callable[..., Result], *args: Any, urgent: bool = True) -> Result:
        try:
            result = self._runner.run(function, *args, urgent=urgent)
        except WorkerEndedError as error:  # the sample must not be lost
            self.trouble = f'{error}; the node itself has evaluated the stop'
            return function(*args)
        self.trouble = ''
        return result


class Progress:
    """Running tasks in words; on_change: called when one begins."""

    def __init__(self) -> None:
        """Start with nothing."""
        self._works: list[str] = []
        self.on_change: Callable[[], None] = lambda: None

    @property
    def text(self) -> str:
        """Return the running tasks; empty without any."""
        return '; '.join(self._works)

    @contextmanager
    def doing(self, work: str) -> Iterator[None]:
        """List a task while it is running."""
        self._works.append(work)
        try:
            self.on_change()
            yield
        finally:
            self._works.remove(work)


def main() -> None:
    """Run as the worker process: execute requests from stdin until its end."""
    os.nice(int(sys.argv[1]))
    results = os.fdopen(os.dup(1), 'wb')
    os.dup2(2, 1)  # prints go to stderr: stdout carries the results
    requests: queue.SimpleQueue[tuple[Callable[..., Any], tuple[Any, ...]]] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(requests,), daemon=True).start()
    try:
        while True:
            function, args = requests.get()
            results.write(pickle.dumps(_outcome(function, args)))
            results.flush()
            trim_memory()
    except BrokenPipeError:  # a normal exit would wait for the thread that reads stdin
        os._exit(0)


def _listen(requests: queue.SimpleQueue[Any]) -> None:
    """Queue requests; end the process at once at the end of stdin."""
    try:
        while True:
            requests.put(pickle.load(sys.stdin.buffer))
    except (EOFError, pickle.UnpicklingError):  # the other process ended, maybe in a write
        os._exit(0)
    except Exception:  # noqa: BLE001 - the rest of the stream is not readable
        traceback.print_exc()
        os._exit(1)


def _outcome(function: Callable[..., Any], args: tuple[Any, ...]) -> tuple[Any, Exception | None]:
    try:
        return function(*args), None
    except HandeyeError as error:
        return None, error
    except Exception as error:  # noqa: BLE001 - it is raised in the calling process
        error.add_note(traceback.format_exc())  # a traceback cannot be pickled
        return None, error


def trim_memory() -> None:
    """
    Return freed memory to the system, if the C library can (glibc); takes milliseconds.

    A stop has thousands of messages, a few of which are kept. Without this the freed memory
    between them would stay with the process and grow from stop to stop.
    """
    if TRIM is not None:
        TRIM(0)


if __name__ == '__main__':
    main()
