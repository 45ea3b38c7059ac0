"""Threads that each do one work whenever they are woken, and what is being done, in words."""
from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import threading
import traceback

from handeye_ros.errors import HandeyeError


class Threads:
    """The threads, and what of their last work failed."""

    def __init__(self, on_failure: Callable[[str], object]) -> None:
        """Start with none; on_failure: receives the traceback of work that failed."""
        self._on_failure = on_failure
        self._failures: dict[str, str] = {}
        self._ended = False

    @property
    def failure(self) -> str:
        """Return what of the last work failed, empty where nothing did."""
        return '; '.join(self._failures.values())

    def start(self, wake: threading.Event, work: Callable[[], None]) -> None:
        """Let a thread do a work each time that it is woken, until the process ends."""
        threading.Thread(target=self._run, args=(wake, work), name=work.__name__,
                         daemon=True).start()

    def stop(self) -> None:
        """Begin nothing any more, and tell nothing of what fails from now on."""
        self._ended = True

    def _run(self, wake: threading.Event, work: Callable[[], None]) -> None:
        while not self._ended:
            wake.wait()
            wake.clear()
            try:
                work()
                self._failures.pop(work.__name__, None)
            except HandeyeError as error:  # such as a process that ended: once it is tried again
                if work.__name__ not in self._failures:
                    wake.set()
                self._failures[work.__name__] = str(error)
            except Exception as error:  # noqa: BLE001 - the next stop must be judged all the same
                if self._ended:
                    return
                self._failures[work.__name__] = (
                    f'the work on the samples failed, which should not happen: {error!r}; see '
                    'the log, and please report it')
                self._on_failure(traceback.format_exc())


class Progress:
    """What takes long and is being done; on_change: called when something begins."""

    def __init__(self) -> None:
        """Start with nothing."""
        self._works: list[str] = []
        self.on_change: Callable[[], None] = lambda: None

    @property
    def text(self) -> str:
        """Return it in words; empty for nothing."""
        return '; '.join(self._works)

    @contextmanager
    def doing(self, work: str) -> Iterator[None]:
        """Tell that a work is being done."""
        self._works.append(work)
        try:
            self.on_change()
            yield
        finally:
            self._works.remove(work)
