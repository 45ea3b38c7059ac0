"""
What takes its time, in other processes: streams and services share no interpreter with it.

A thread would not do: Python runs one at a time, and a solve would slow down all others, as the
streams would slow down the judging of a stop. A process is started when it is first needed.
"""
from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
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
from typing import Any, Protocol, TypeVar

from handeye_ros.config import Config
from handeye_ros.data import Reject, Sample
from handeye_ros.errors import HandeyeError
from handeye_ros.ros.errors import WorkerEndedError
from handeye_ros.sampling.station_features import evenly
from handeye_ros.sampling.stops import judged, needed, Outcome, result_of, sample_of, Stop

Result = TypeVar('Result')
TRIM = getattr(ctypes.CDLL(None), 'malloc_trim', None)  # of glibc alone
COMMAND = (sys.executable, '-m', 'handeye_ros.ros.node.worker')


class Runner(Protocol):
    """Runs functions of modules; arguments, results and errors can be pickled."""

    def run(self, function: Callable[..., Result], *args: Any, urgent: bool = False) -> Result:
        """Return what a function returns; raises what it raises."""

    def stop(self) -> None:
        """End, whatever is being done."""


class InProcess:
    """Runs them at once, by whoever asks."""

    def run(self, function: Callable[..., Result], *args: Any, urgent: bool = False) -> Result:
        """Return what a function returns; raises what it raises."""
        return function(*args)

    def stop(self) -> None:
        """Do nothing."""


class Parts(list[bytes]):
    """What is pickled, in parts: a whole of some MB would leave holes in the memory."""

    write = list.append


class WorkerProcess:
    """
    Runs them in a process, one after the other; what is urgent is the next.

    The process ends with this one, also where this one is killed: nobody writes to it any more.
    """

    def __init__(self, nicer: int = 0) -> None:
        """Start nothing yet; nicer: by so much its priority is lower than that of the streams."""
        self._command = (*COMMAND, str(nicer))
        self._process: subprocess.Popen[bytes] | None = None
        self._turns = threading.Condition()
        self._busy, self._urgent, self._stopped = False, 0, False
        self._suspended = False  # by a signal; it was ended for that

    def run(self, function: Callable[..., Result], *args: Any, urgent: bool = False) -> Result:
        """Return what a function returns; raises what it raises, and WorkerEndedError."""
        self._begin(urgent)
        try:
            return self._asked(function, args)
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

    def _asked(self, function: Callable[..., Result], args: tuple[Any, ...]) -> Result:
        asked = Parts()  # all of it or, where that fails, nothing is sent
        pickle.dump((function, args), asked)
        process = self._running()
        assert process.stdin and process.stdout
        try:
            process.stdin.writelines(asked)
            process.stdin.flush()
            result, error = pickle.load(process.stdout)
        except (EOFError, OSError, pickle.UnpicklingError) as ended:
            process.kill()
            code = process.wait()
            raise WorkerEndedError(-signal.SIGSTOP if self._suspended else code) from ended
        if error is not None:
            raise error
        return result

    def _running(self) -> subprocess.Popen[bytes]:
        """Return the process, started where none runs; raises WorkerEndedError."""
        with self._turns:
            if self._stopped:
                raise WorkerEndedError(0)
            if self._process is None or self._process.poll() is not None:
                # a group of its own: Ctrl-C in the terminal is for this process alone; no session
                # of its own, as Linux lets priorities count within a session only
                self._process = subprocess.Popen(self._command, stdin=subprocess.PIPE,
                                                 stdout=subprocess.PIPE, process_group=0)
                self._suspended = False
                threading.Thread(target=self._watch, args=(self._process,), daemon=True).start()
            return self._process

    def _watch(self, process: subprocess.Popen[bytes]) -> None:
        """End a process that is suspended (SIGSTOP): who asks it would wait for ever."""
        with suppress(ChildProcessError):  # it has ended, and somebody knows
            change = os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
            if change and change.si_code == os.CLD_STOPPED:
                self._suspended = True
                process.kill()

    def stop(self) -> None:
        """End the process, whatever it does; whoever waits for it gets a WorkerEndedError."""
        with self._turns:
            self._stopped = True
            if self._process is not None:
                self._process.kill()
                self._process.wait()


class Judge:
    """
    Tells what stops give, in a process of its own; where that ends, in this one.

    trouble: why the last one was judged here, empty where it was not.
    """

    def __init__(self, runner: Runner) -> None:
        """Take what runs it."""
        self._runner = runner
        self.trouble = ''

    def begin(self) -> None:
        """Let the process start, and import what it needs, before somebody waits for it."""
        threading.Thread(target=self._run, args=(evenly, (), 1), daemon=True).start()

    def stop(self) -> None:
        """End the process."""
        self._runner.stop()

    def result(self, stop: Stop, config: Config) -> Sample | Reject:
        """Return the sample of a stop, or why it gives none."""
        return self._run(result_of, needed(stop, config), config)

    def sample(self, stop: Stop, config: Config) -> Sample:
        """Return the sample of a stop; raises NoProfilesError or FeatureError with the reason."""
        return self._run(sample_of, needed(stop, config), config)

    def again(self, outcome: Outcome, config: Config) -> Outcome:
        """Return what becomes of the same stop with another configuration; others come first."""
        bare = replace(outcome, result=Reject(outcome.result.stamp, ''))
        return replace(outcome, result=self._run(judged, bare, config, urgent=False).result)

    def _run(self, function: Callable[..., Result], *args: Any, urgent: bool = True) -> Result:
        try:
            result = self._runner.run(function, *args, urgent=urgent)
        except WorkerEndedError as error:  # the sample must not be lost with it
            self.trouble = f'{error}; the node itself has judged the stop'
            return function(*args)
        self.trouble = ''
        return result


def main() -> None:
    """Be the second process: do what comes from stdin, until nobody can write there any more."""
    os.nice(int(sys.argv[1]))
    answers = os.fdopen(os.dup(1), 'wb')
    os.dup2(2, 1)  # what is printed is no answer
    asked: queue.SimpleQueue[tuple[Callable[..., Any], tuple[Any, ...]]] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(asked,), daemon=True).start()
    try:
        while True:
            function, args = asked.get()
            answers.write(pickle.dumps(_outcome(function, args)))
            answers.flush()
            give_back()
    except BrokenPipeError:  # nobody listens; an orderly end would wait for who reads stdin
        os._exit(0)


def _listen(asked: queue.SimpleQueue[Any]) -> None:
    """Take what is asked for; end the process at once where nobody is left to ask."""
    try:
        while True:
            asked.put(pickle.load(sys.stdin.buffer))
    except (EOFError, pickle.UnpicklingError):  # it ended, or was killed while it wrote
        os._exit(0)
    except Exception:  # noqa: BLE001 - nobody could tell what comes next
        traceback.print_exc()
        os._exit(1)


def _outcome(function: Callable[..., Any], args: tuple[Any, ...]) -> tuple[Any, Exception | None]:
    try:
        return function(*args), None
    except HandeyeError as error:
        return None, error
    except Exception as error:  # noqa: BLE001 - it is told where it was asked for
        error.add_note(traceback.format_exc())  # the traceback itself cannot go there
        return None, error


def give_back() -> None:
    """
    Give freed memory back to the system, where the C library can; takes milliseconds.

    It keeps what lies between blocks that are in use: after a stop of thousands of messages, of
    which a few are kept, that is most of it, and it grows from stop to stop.
    """
    if TRIM is not None:
        TRIM(0)


if __name__ == '__main__':
    main()
