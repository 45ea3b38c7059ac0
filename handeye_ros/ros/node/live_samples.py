"""
The samples of a running node: judged, stored and changed from different threads.

Knows no ROS. What a stop asks for (to extract, to store) is done by a worker or by whoever asks,
one thing after the other, while messages go on coming in. What takes longer holds up none of it.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import threading

from handeye_ros.config import Config
from handeye_ros.data import Reject, Sample
from handeye_ros.diagnosis.summaries import count_of, sample_summary
from handeye_ros.errors import HandeyeError, InputError
from handeye_ros.ros.node.judging import Judge
from handeye_ros.ros.node.live_streams import LiveStreams
from handeye_ros.ros.node.second import Here, Runner
from handeye_ros.ros.node.settings import changes_samples
from handeye_ros.ros.node.store import NoStore, Store
from handeye_ros.sampling.errors import FlatCrossingError, NothingNewError
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.state import Attempt
from handeye_ros.sampling.stops import Outcome, Stop


class LiveSamples(LiveStreams):
    """
    The samples of a running node.

    on_outcome: called with each new outcome.
    """

    def __init__(self, config: Config, store: Store | None = None, judging: Runner | None = None
                 ) -> None:
        """Start empty; judging: runs what tells what a stop gives. Raises BadValueError."""
        super().__init__(config)
        self._work = threading.RLock()  # of what is done with it, one thing after the other
        self._judging = Judge(judging or Here())
        self._store = store or NoStore()
        self._cleared = 0  # how often
        self._anew = threading.Lock()  # of extracting the samples anew
        self._stale = False  # whether that is to be done
        self.attempt: Attempt | None = None
        self.store_trouble = ''
        self.on_outcome: Callable[[Outcome], None] = lambda outcome: None

    def restore(self, session: Session, before: Config) -> str:
        """
        Go on with the stops of an earlier run; return what to say.

        before: its settings; other ones are stored. Raises UnwritableError.
        """
        with self._work, self._lock:
            self._session = session
        if replace(before, session=self.config.session) != self.config:
            self._store.configured(self.config)
        self._wake.set()
        count = sum(outcome.sample is not None for outcome in session.outcomes)
        return f'going on with {count_of(count, "sample")} of {self.path}'

    @property
    def path(self) -> str:
        """Return the folder of the session, empty before the first sample is stored."""
        return self._store.path

    # what becomes of the stops

    def judge_all(self) -> None:
        """Judge every stop that is over."""
        with self._work:
            while self._stops:
                self._judge(self._stops.popleft())

    def _judge_rest(self) -> None:
        """Judge every stop, also the one that the robot stands in."""
        with self._work:
            self.judge_all()
            for stop in self.copied().rest():
                self._judge(stop)

    def _judge(self, stop: Stop) -> None:
        result = self._judging.result(stop, self.config)
        with self._lock:
            outcome = self._session.outcome(stop, result)
        remark = self._why_not(outcome)  # by itself the node takes what a recording gives
        try:
            outcome = self._stored(outcome)
        except InputError as error:
            outcome = Outcome(outcome.number, stop, Reject(outcome.result.stamp, str(error)))
        self._put(outcome)
        self._told(outcome.sample is not None, outcome.number, (
            f'sample {outcome.number} taken: ' if outcome.sample else
            f'stop {outcome.number} gave no sample: ') + sample_summary(outcome.result)
            + (f'; {remark}' if remark else ''))
        self.on_outcome(outcome)

    def _stored(self, outcome: Outcome) -> Outcome:
        """Return an outcome that is on the disk; raises InputError, which is told until then."""
        try:
            stored = self._store.add(outcome, self.config)
        except InputError as error:
            self.store_trouble = str(error)
            raise
        self.store_trouble = ''
        return stored

    def _put(self, outcome: Outcome) -> None:
        with self._lock:
            self._session.put(outcome)

    def extract_anew(self) -> None:
        """Let the stored profiles give what the settings of now make of them, if these ask."""
        with self._anew:
            while self._stale:
                with self._work, self._lock:  # so that nothing is judged by the settings before
                    self._stale, outcomes = False, self._session.outcomes
                with self._doing('the samples are extracted anew from their profiles'):
                    fresh = [self._judging.anew(outcome, self.config) for outcome in outcomes]
                    with self._lock:
                        self._session.replace(fresh)

    # what is asked; each returns what to say

    def take_sample(self) -> str:
        """Take a sample where the robot stands; raises DataError, or InputError unstored."""
        try:
            return self._take()
        except HandeyeError as error:
            self._told(False, 0, str(error))
            raise
        finally:
            self._wake.set()

    def _take(self) -> str:
        stop, sample, known = self._sampled()  # while others are stored, and told at once if none
        with self._work:
            self.judge_all()
            if known != (self._cleared, self.config):
                stop, sample, _ = self._sampled()
            with self._lock:
                outcome = self._session.outcome(stop, sample)
                again = any(o.stop.began == stop.began for o in self._session.outcomes)
            if outcome.sample is None:
                raise NothingNewError(sample_summary(outcome.result))
            why = self._why_not(outcome)
            if why:
                raise FlatCrossingError(why)
            outcome = self._stored(outcome)
            self._put(outcome)
        again_text = ' again, as the robot has not moved since' if again else ''
        text = f'sample {outcome.number} taken{again_text}: {sample_summary(sample)}'
        self._told(True, outcome.number, text)
        self.on_outcome(outcome)
        return text

    def _sampled(self) -> tuple[Stop, Sample, tuple[int, Config]]:
        """Return the stop that the robot stands in, its sample, and what was known with it."""
        known = self._cleared, self.config
        stop = self._here()
        return stop, self._judging.sample(stop, known[1]), known

    def _here(self) -> Stop:
        """Return the stop that the robot stands in."""
        with self._lock:
            return self._session.here()

    def _why_not(self, outcome: Outcome) -> str:
        """Return what of a new sample is no good, as far as the others tell; empty if all is."""
        return ''

    def _told(self, accepted: bool, number: int, text: str) -> None:
        self.attempt = Attempt(accepted, number, text)

    def remove_last_sample(self) -> str:
        """Forget the last sample; raises DataError when there is none, InputError unstored."""
        with self._work:
            self.judge_all()
            last = self.copied().last(self._judging.result)
            self._store.remove(last.number, self.config)
            with self._lock:
                self._session.remove(last)
                count = sum(o.sample is not None for o in self._session.outcomes)
        self._wake.set()
        return (f'removed sample {last.number}, the last one ({sample_summary(last.result)}); '
                f'{count} left')

    def clear_samples(self) -> str:
        """Forget all samples, and all that was received; raises InputError."""
        with self._work:
            kept = self._store.restart(self.config)
            self.latest.clear()
            with self._lock:
                self._stops.clear()
                count = sum(o.sample is not None for o in self._session.outcomes)
                self._session.clear()
                self._cleared += 1
            self.attempt = None
        self._wake.set()
        return (f'{count_of(count, "sample")} removed; bags and clocks may start again{kept}')

    # what is set

    def configure(self, config: Config) -> None:
        """Go on with another configuration, already checked by params.changed."""
        with self._lock:
            before, self.config = self.config, config
            self._session.configure(config)
            self._stale |= changes_samples(before, config)
        try:
            self._store.configured(config)
            self.store_trouble = ''
        except InputError as error:
            self.store_trouble = str(error)
