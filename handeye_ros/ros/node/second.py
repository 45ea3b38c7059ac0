"""
What takes its time, in other processes: streams and services share no interpreter with it.

A thread would not do: Python runs one at a time, and a solve would slow down all others, as the
streams would slow down the judging of a stop. A process is started when it is first needed.
"""
from __future__ import annotations

from collections.abc import Callable
import os
import pickle
import queue
import subprocess
import sys
import threading
import traceback
from typing import Any, Protocol, TypeVar

from handeye_ros.errors import HandeyeError
from handeye_ros.ros.errors import SecondEndedError
from handeye_ros.ros.node.memory import give_back

Result = TypeVar('Result')
COMMAND = (sys.executable, '-m', 'handeye_ros.ros.node.second')


class Runner(Protocol):
    """Runs functions of modules; arguments, results and errors can be pickled."""

    def run(self, function: Callable[..., Result], *args: Any, urgent: bool = False) -> Result:
        """Return what a function returns; raises what it raises."""

    def stop(self) -> None:
        """End, whatever is being done."""


class Here:
    """Runs them at once, by whoever asks."""

    def run(self, function: Callable[..., Result], *args: Any, urgent: bool = False) -> Result:
        """Return what a function returns; raises what it raises."""
        return function(*args)

    def stop(self) -> None:
        """Do nothing."""


class Parts(list[bytes]):
    """What is pickled, in parts: a whole of some MB would leave holes in the memory."""

    write = list.append


class Second:
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

    def run(self, function: Callable[..., Result], *args: Any, urgent: bool = False) -> Result:
        """Return what a function returns; raises what it raises, and SecondEndedError."""
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
        except (EOFError, OSError) as ended:
            raise SecondEndedError(process.wait()) from ended
        if error is not None:
            raise error
        return result

    def _running(self) -> subprocess.Popen[bytes]:
        """Return the process, started where none runs; raises SecondEndedError."""
        with self._turns:
            if self._stopped:
                raise SecondEndedError(0)
            if self._process is None or self._process.poll() is not None:
                # a group of its own: Ctrl-C in the terminal is for this process alone; no session
                # of its own, as Linux lets priorities count within a session only
                self._process = subprocess.Popen(self._command, stdin=subprocess.PIPE,
                                                 stdout=subprocess.PIPE, process_group=0)
            return self._process

    def stop(self) -> None:
        """End the process, whatever it does; whoever waits for it gets a SecondEndedError."""
        with self._turns:
            self._stopped = True
            if self._process is not None:
                self._process.kill()
                self._process.wait()


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


if __name__ == '__main__':
    main()
