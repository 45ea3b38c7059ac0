"""
The session: all stops of a recording or of a running node, and their outcomes.

The same Session takes the messages of a bag and those of live topics.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Self

from handeye_ros import targets
from handeye_ros.config import Config
from handeye_ros.data import Reject, Sample
from handeye_ros.errors import DataError, InputError
from handeye_ros.sampling.dwell_detector import DwellDetector
from handeye_ros.sampling.dwells import NS
from handeye_ros.sampling.passes import single_samples
from handeye_ros.sampling.stops import (
    duplicate_pose,
    MOST_PROFILES,
    needed,
    Outcome,
    result_of,
    sample_of,
    Stop,
)

# time after a dwell is long enough (s), and profiles needed for a sample at that time
EARLY_CHECKS = ((0.0, MOST_PROFILES), (0.3, 1), (1.3, 0), (3.3, 0), (7.3, 0))


class Session(DwellDetector):
    """Receives poses and profiles and turns each stop into a sample or a reject."""

    def __init__(self, config: Config) -> None:
        """Start with no samples; raises BadValueError for a method that does not exist."""
        targets.method_for(config)
        super().__init__(config)

    def clear(self) -> None:
        """Forget all samples and all messages."""
        super().clear()
        self._checks = 0  # checks by early() in this dwell; next one, and the first (ns)
        self._early_at = self._early_from = 0
        self._outcomes: list[Outcome] = []
        self._numbers = 0  # assigned so far

    @property
    def base_frame(self) -> str:
        """Return the frame of the poses, empty before the first one."""
        return (self._pose_stream.frame or '').lstrip('/')

    def with_base(self, config: Config) -> Config:
        """Return the settings with the frame of the poses as the base, if they name none."""
        return config if config.robot_base_frame else replace(
            config, robot_base_frame=self.base_frame)

    @property
    def conflict(self) -> InputError | None:
        """Return the error of contradicting frames, or None."""
        wanted = self._config.robot_base_frame.lstrip('/')
        if wanted and self.base_frame and wanted != self.base_frame:
            return InputError(f'the poses are given in "{self.base_frame}", but robot_base_frame '
                              f'is "{wanted}": set it to {self.base_frame}, or leave it out; it '
                              'is then that of the poses', reason='base_frame')
        return super().conflict

    def copied(self) -> Self:
        """Return an independent copy."""
        other = super().copied()
        other._outcomes = list(self._outcomes)
        return other

    def replace(self, outcomes: Iterable[Outcome]) -> None:
        """Replace the outcomes of stops, except those removed in the meantime."""
        fresh = {id(outcome.stop): outcome for outcome in outcomes}
        self._outcomes = [fresh.get(id(outcome.stop), outcome) for outcome in self._outcomes]

    def restore(self, outcomes: Sequence[Outcome], numbers: int, frame_id: str) -> None:
        """Continue from the stops of an earlier run; numbers: how many were assigned."""
        self.clear()
        self._outcomes, self._numbers = list(outcomes), numbers
        self._taken = {outcome.stop.began for outcome in outcomes} | ({-1} if numbers else set())
        self._profile_stream.frame = frame_id or None

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """Return the outcomes in the order of their numbers."""
        return tuple(sorted(self._outcomes, key=lambda outcome: outcome.number))

    @property
    def numbers(self) -> int:
        """Return the last number assigned."""
        return self._numbers

    @property
    def samples(self) -> tuple[Sample, ...]:
        """Return the samples, without those of samples.exclude."""
        return single_samples([o.sample for o in self._outcomes
                               if o.sample and not self.excludes(o)])

    @property
    def rejects(self) -> tuple[Reject, ...]:
        """Return the stops without a sample or with an excluded one, with the reasons."""
        return tuple(o.result if isinstance(o.result, Reject) else
                     Reject(o.result.stamp, f'sample {o.number} is left out by samples.exclude')
                     for o in self._outcomes
                     if isinstance(o.result, Reject) or self.excludes(o))

    def excludes(self, outcome: Outcome) -> bool:
        """Return whether samples.exclude contains a sample."""
        return outcome.number in self._config.samples.exclude

    def collect(self) -> list[Sample | Reject]:
        """Return the outcomes of stops completed in both streams since the last call."""
        return self._judged(self.passed())

    def finish(self) -> list[Sample | Reject]:
        """
        Return the outcomes of all remaining stops, including the current one.

        Raises InputError when messages of two frames came on one topic.
        """
        return self._judged(self.rest())

    def _judged(self, stops: Sequence[Stop]) -> list[Sample | Reject]:
        """Return the outcomes of stops and store them."""
        return [self.put(self.outcome(stop, result_of(stop, self._config))).result
                for stop in stops]

    def outcome(self, stop: Stop, result: Sample | Reject) -> Outcome:
        """Return the numbered outcome of a stop; a duplicate pose gives no sample."""
        before = [o for o in self._outcomes if o.stop.began == stop.began]
        number = before[0].number if before else self._numbers + 1
        others = [o for o in self._outcomes if o not in before and not self.excludes(o)]
        why = '' if isinstance(result, Reject) or result.single else duplicate_pose(
            result, others, self._config)
        return Outcome(number, stop, Reject(result.stamp, why) if why else result, why)

    def put(self, outcome: Outcome, over: bool = True) -> Outcome:
        """Store and return the outcome of a stop in place of an earlier one."""
        began = outcome.stop.began
        self._outcomes = [o for o in self._outcomes if o.stop.began != began] + [outcome]
        self._numbers = max(self._numbers, outcome.number)
        if over:
            self._taken.add(began)
        return outcome

    def is_taken(self, stop: Stop) -> bool:
        """Return whether a stop was already sampled, or is to be ignored."""
        return stop.began in self._taken

    def leave(self, stop: Stop) -> None:
        """Mark a stop as taken, so that it is not returned again."""
        self._taken.add(stop.began)

    def standing(self) -> Stop | None:
        """Return the current stop if it is sampled automatically."""
        dwell = self._finder.current()
        if dwell is None or not self._by_itself or dwell.began in self._taken:
            return None
        return self._stop(dwell)

    def early(self) -> Stop | None:
        """
        Return the current stop as soon as it has enough profiles for a sample.

        It needs MOST_PROFILES at first, and fewer later (EARLY_CHECKS). A stop without a sample is
        returned a few more times, as the cause may be gone. passed() returns it again when it is
        over.
        """
        stood = self._finder.stood
        if stood < self._early_at:
            if stood < self._early_from:  # another dwell
                self._checks, self._early_at = 0, self._early_from
            return None
        sampling = self._config.sampling
        self._early_from = round((sampling.still_time + 2 * sampling.settle_time) * NS)
        if sampling.moving or self._checks == len(EARLY_CHECKS):
            return None
        seconds, least = EARLY_CHECKS[self._checks]
        self._early_at = self._early_from + round(seconds * NS)
        if stood < self._early_at:
            return None
        self._checks += 1
        stop = self.standing()
        if stop is None or any(o.sample and o.stop.began == stop.began for o in self._outcomes):
            return None
        profiles = needed(stop, self._config).load(self._config).profiles
        return stop if len(profiles) >= least else None

    def take_sample(self) -> Sample:
        """
        Return a sample of the current stop.

        Raises what current_stop() and sample_of() raise, or DataError (reason nothing_new).
        """
        stop = self.current_stop()
        outcome = self.outcome(stop, sample_of(stop, self._config))
        if isinstance(outcome.result, Reject):
            raise DataError(f'{outcome.result.reason}: move on, and turn the tool',
                            reason='nothing_new')
        self.put(outcome)
        return outcome.result

    def last(self, judge: Callable[[Stop, Config], Sample | Reject] = result_of) -> Outcome:
        """
        Return the last sample, which may be of the current stop.

        judge: tells what a stop gives. Raises DataError when there is none.
        """
        standing = self.standing()
        if standing:
            outcome = self.outcome(standing, judge(standing, self._config))
            if outcome.sample:
                return outcome
        samples = [outcome for outcome in self._outcomes if outcome.sample]
        if not samples:
            raise DataError('there is no sample to remove', reason='nothing_to_remove')
        return max(samples, key=lambda outcome: outcome.number)

    def remove(self, outcome: Outcome) -> None:
        """Forget the outcome of a stop; the stop counts as taken."""
        self._taken.add(outcome.stop.began)
        self._outcomes = [o for o in self._outcomes if o.number != outcome.number]

    def remove_last(self) -> Outcome:
        """Forget the last sample and return it; raises DataError when there is none."""
        last = self.last()
        self.remove(last)
        return last
