"""
What stops give, told by a process of its own: an answer is late where it waits for the streams.

Knows no ROS.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import threading
from typing import Any, TypeVar

from handeye_ros.config import Config
from handeye_ros.data import Reject, Sample
from handeye_ros.ros.errors import SecondEndedError
from handeye_ros.ros.node.second import Runner
from handeye_ros.sampling.stops import evenly, judged, needed, Outcome, result_of, sample_of, Stop

Result = TypeVar('Result')


class Judge:
    """Tells what stops give; where its process ends, by itself."""

    def __init__(self, runner: Runner) -> None:
        """Take what runs it."""
        self._runner = runner

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

    def anew(self, outcome: Outcome, config: Config) -> Outcome:
        """Return what becomes of the same stop with another configuration; others come first."""
        bare = replace(outcome, result=Reject(outcome.result.stamp, ''))
        return replace(outcome, result=self._run(judged, bare, config, urgent=False).result)

    def _run(self, function: Callable[..., Result], *args: Any, urgent: bool = True) -> Result:
        try:
            return self._runner.run(function, *args, urgent=urgent)
        except SecondEndedError:  # out of memory perhaps: the sample must not be lost with it
            return function(*args)
