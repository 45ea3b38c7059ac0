"""
The samples of a running node: evaluated, stored and changed by several threads.

Knows no ROS. One lock (work) serialises these changes while messages continue to arrive; longer
computations (review, solve) do not hold it.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import threading

from handeye_ros.bags.session_store import Store
from handeye_ros.checks.review import count_of, sample_summary
from handeye_ros.config import Config, flatten
from handeye_ros.data import Array, Reject, Sample
from handeye_ros.errors import DataError, FeatureError, HandeyeError, InputError
from handeye_ros.node.state import Attempt
from handeye_ros.node.streams import StopConsumer, Streams
from handeye_ros.node.worker import Evaluator, Progress
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Outcome, Stop

# Keys, or prefixes of keys, that affect the sample of a stop.
SAMPLE_KEYS = ('method', 'profile.', 'target.', 'noise.sensor', 'sampling.min_points',
               'sampling.settle_time', 'time_offset', 'rotation_lag_std')


class LiveSamples:
    """
    The samples of a running node.

    work: the lock for changes; cleared: number of times that they were cleared; consumer: receives
    the stops instead, or None; objection: returns why a new sample does not help, or ''; refused:
    T_base_flange (4, 4) of requested stops that gave no sample, by the stamp of their start;
    on_outcome: called with each new outcome.
    """

    def __init__(self, streams: Streams, evaluator: Evaluator, store: Store, progress: Progress
                 ) -> None:
        """Start empty."""
        self.streams, self.evaluator, self.store = streams, evaluator, store
        self._progress = progress
        self.work = threading.RLock()
        self.cleared = 0
        self._extracting = threading.Lock()
        self._stale = False  # whether the samples must be extracted again
        self._unstored: set[int] = set()  # numbers of stops that could not be stored
        self.attempt: Attempt | None = None
        self.refused: dict[int, Array] = {}
        self.store_trouble = ''
        self.consumer: StopConsumer | None = None
        self.objection: Callable[[Outcome], str] = lambda outcome: ''
        self.on_outcome: Callable[[Outcome], None] = lambda outcome: None

    @property
    def config(self) -> Config:
        """Return the current settings."""
        return self.streams.config

    def restore(self, session: Session, old_config: Config) -> str:
        """
        Continue with the stops of an earlier run; return the message.

        old_config: its settings; the current ones are stored if they differ. Raises
        UnwritableError.
        """
        with self.work, self.streams.lock:
            self.streams.session = session
        if replace(old_config, session=self.config.session) != self.config:
            self.store.configured(self.config)
        self.streams.wake.set()
        count = sum(outcome.sample is not None for outcome in session.outcomes)
        return f'continuing with {count_of(count, "sample")} of {self.store.path}'

    def evaluate_all(self) -> None:
        """Evaluate all complete stops, and the current one once it has enough profiles."""
        with self.work:
            while self.streams.waiting:
                self._evaluate(self.streams.waiting.popleft())
            early, self.streams.early = self.streams.early, None
            if early:
                self._evaluate(early, complete=False)

    def evaluate_rest(self) -> None:
        """Evaluate all stops; the current one counts as complete."""
        with self.work:
            self.evaluate_all()
            for stop in self.streams.copied().rest():
                self._evaluate(stop)

    def _evaluate(self, stop: Stop, complete: bool = True) -> None:
        """Put the outcome of a stop into the session, replacing an earlier one."""
        if consumer := self.consumer:
            if complete or not self.streams.is_taken(stop):
                consumer.add(stop, complete)
            return
        result = self.evaluator.result(stop, self.config)
        with self.streams.lock:
            session = self.streams.session
            if not complete and session.is_taken(stop):  # meanwhile, by a service
                return
            outcome = session.outcome(stop, result)
            earlier = [o for o in session.outcomes if o.number == outcome.number]
        remark = self.objection(outcome)  # no refusal, as in the solution of a recording
        try:
            outcome = self._stored(outcome)
        except InputError as error:
            if earlier and outcome.number not in self._unstored:
                outcome = earlier[0]  # of fewer profiles, but on the disk
            else:
                self._unstored.add(outcome.number)
                outcome = Outcome(outcome.number, stop, Reject(outcome.result.stamp, str(error)),
                                  refused=str(error))
        with self.streams.lock:
            self.streams.session.put(outcome, complete)
        if earlier and bool(earlier[0].sample) == bool(outcome.sample):
            return  # the same result with more profiles is not reported again
        verdict = (f'sample {outcome.number} taken' if outcome.sample else
                   f'stop {outcome.number} gave no sample')
        text = '; '.join(filter(None, (sample_summary(outcome.result), remark)))
        self.attempt = Attempt(outcome.sample is not None, outcome.number, f'{verdict}: {text}')
        self.on_outcome(outcome)

    def _stored(self, outcome: Outcome) -> Outcome:
        """Store an outcome; return the stored form. Raises InputError, kept as trouble."""
        try:
            stored = self.store.add(outcome, self.config)
        except InputError as error:
            self.store_trouble = str(error)
            raise
        self.store_trouble = ''
        self._unstored.discard(outcome.number)
        return stored

    def session_after(self, evaluate: Callable[[], None]) -> tuple[Session, Config]:
        """
        Return a copy of the session, and the settings of all its samples.

        evaluate: evaluate_all or evaluate_rest. Raises DataError where there are no stops.
        """
        self.extract_again()
        with self.work:
            evaluate()
            session, config = self.streams.copied(), self.config
        self.streams.wake.set()
        session.require_stations()
        return session, config

    def extract_again(self) -> None:
        """Evaluate the stored stops again if changed settings affect them."""
        with self._extracting:
            while self._stale:
                with self.work, self.streams.lock:  # no evaluation with the old settings
                    self._stale, outcomes = False, self.streams.session.outcomes
                with self._progress.doing('the samples are extracted again from their profiles'):
                    for outcome in outcomes:
                        fresh = self._extracted_again(outcome)
                        with self.streams.lock:
                            self.streams.session.replace([fresh])

    def _extracted_again(self, outcome: Outcome) -> Outcome:
        """Return the outcome of a stop by the current settings; unstored, it stays refused."""
        if outcome.number not in self._unstored:
            return self.evaluator.reevaluated(outcome, self.config)
        result = self.evaluator.result(outcome.stop, self.config)
        with self.streams.lock:
            fresh = self.streams.session.outcome(outcome.stop, result)
        try:
            # its stop is now that on the disk; the session knows it by the one in memory
            return replace(self._stored(fresh), stop=outcome.stop)
        except InputError:
            return outcome

    # services; each returns its message

    def take(self) -> str:
        """Take a sample at the current stop; raises DataError, or InputError unstored."""
        try:
            return self._take()
        except HandeyeError as error:
            self.attempt = Attempt(False, 0, str(error))
            raise
        finally:
            self.streams.wake.set()

    def _take(self) -> str:
        if consumer := self.consumer:
            stop = self.streams.standing()
            with self.work:
                self.evaluate_all()
                return consumer.take(stop)
        stop, sample, state = self._sampled()  # outside of work: others are stored meanwhile
        with self.work:
            self.evaluate_all()
            if state != (self.cleared, self.config):
                stop, sample, _ = self._sampled()
            with self.streams.lock:
                outcome = self.streams.session.outcome(stop, sample)
                repeated = any(o.stop.began == stop.began for o in self.streams.session.outcomes)
            if outcome.sample is None:
                raise DataError(f'{sample_summary(outcome.result)}: move on, and turn the tool',
                                reason='nothing_new')
            objection = self.objection(outcome)
            if objection:
                self.refused[stop.began] = stop.pose(self.config)
                raise DataError(f'{objection}, and take the sample again',
                                reason='flat_crossing')
            outcome = self._stored(outcome)
            with self.streams.lock:
                self.streams.session.put(outcome)
        note = ' again, as the robot has not moved since' if repeated else ''
        text = f'sample {outcome.number} taken{note}: {sample_summary(sample)}'
        self.attempt = Attempt(True, outcome.number, text)
        self.on_outcome(outcome)
        return text

    def _sampled(self) -> tuple[Stop, Sample, tuple[int, Config]]:
        """Return the current stop, its sample, and the settings version it was made with."""
        state = self.cleared, self.config
        stop = self.streams.standing()
        try:
            return stop, self.evaluator.sample(stop, state[1]), state
        except FeatureError:
            self.refused[stop.began] = stop.pose(state[1])
            raise

    def remove_last(self) -> str:
        """Forget the last sample; raises DataError when there is none, InputError unstored."""
        with self.work:
            self.evaluate_all()
            last = self.streams.copied().last(self.evaluator.result)
            self.store.remove(last.number, self.config)
            with self.streams.lock:
                self.streams.session.remove(last)
                count = sum(o.sample is not None for o in self.streams.session.outcomes)
        self.streams.wake.set()
        return (f'removed sample {last.number}, the last one ({sample_summary(last.result)}); '
                f'{count} left')

    def clear(self) -> str:
        """Forget all samples and messages; raises InputError."""
        with self.work:
            note, count = self.store.restart(self.config), self.forget()
        self.streams.wake.set()
        return f'{count_of(count, "sample")} removed; bags and clocks may start again{note}'

    def forget(self) -> int:
        """Forget the stops and messages; return the number of samples there were."""
        self.streams.latest.clear()
        with self.streams.lock:
            self.streams.waiting.clear()
            self.streams.early = None
            session = self.streams.session
            count = sum(o.sample is not None for o in session.outcomes)
            session.clear()
            self.cleared += 1
        self.attempt, self.refused, self._unstored = None, {}, set()
        return count

    def configure(self, config: Config) -> None:
        """Apply another configuration, already checked by params.changed."""
        with self.streams.lock:
            old_config, self.streams.config = self.config, config
            self.streams.session.configure(config)
            self._stale |= changes(old_config, config, SAMPLE_KEYS)
        try:
            self.store.configured(config)
            self.store_trouble = ''
        except InputError as error:
            self.store_trouble = str(error)


def changes(old_config: Config, new_config: Config, keys: tuple[str, ...]) -> bool:
    """Return whether two configurations differ in a key with one of these prefixes."""
    old, new = flatten(old_config), flatten(new_config)
    return any(old[key] != new[key] for key in new if key.startswith(keys))
