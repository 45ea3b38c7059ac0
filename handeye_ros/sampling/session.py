# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The session: all stops of a recording or of a running node, and what each gives.

The same Session takes the messages of a bag and those of live topics (see collector.py).
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
import math

from handeye_ros import se3, targets
from handeye_ros.config import Config
from handeye_ros.data import Reject, Sample
from handeye_ros.sampling.collector import StopCollector
from handeye_ros.sampling.features import result_of
from handeye_ros.sampling.stops import MOST_PROFILES, NS, Stop
from handeye_ros.sampling.sweep import single_samples
import numpy as np

PATIENCE = 2 * NS  # of a stop without any profile, before it is said that it gives no sample
CHECK_LATER = 1.4  # factor of the time after which a stop without a sample is tried again


@dataclass(frozen=True, eq=False)
class Outcome:
    """
    Result of a stop: a sample, or the reason why there is none.

    number: from 1, never reused in a session; refused: why the stop gives no sample, whatever its
    profiles show, '' if it may.
    """

    number: int
    stop: Stop
    result: Sample | Reject
    refused: str = ''

    @property
    def sample(self) -> Sample | None:
        """Return the sample, or None."""
        return self.result if isinstance(self.result, Sample) else None


def evaluated(outcome: Outcome, config: Config) -> Outcome:
    """Return the outcome of the same stop with another configuration."""
    result = (Reject(outcome.stop.load(config).start, outcome.refused) if outcome.refused
              else result_of(outcome.stop, config))
    return replace(outcome, result=result)


def duplicate_pose(sample: Sample, others: Iterable[Outcome], config: Config) -> str:
    """Return in words which of other stops has the pose of a sample, '' if none."""
    limits = config.sampling
    for other in others:
        if other.sample:
            T = se3.inverse(other.sample.T_base_flange) @ sample.T_base_flange
            away, angle = math.hypot(*T[:3, 3]), float(se3.angle(T[:3, :3]))
            if away < limits.new_translation and angle < limits.new_rotation:
                return (f'{away * 1e3:.0f} mm and {np.degrees(angle):.1f} degrees from '
                        f'sample {other.number}: it brings nothing new')
    return ''


class Session(StopCollector):
    """
    Collects stops, and keeps what each gives.

    numbers: the last number assigned.
    """

    def __init__(self, config: Config) -> None:
        """Start with no samples; raises BadValueError for a method that does not exist."""
        targets.target_for(config)
        super().__init__(config)

    def clear(self) -> None:
        """Forget all samples and all messages."""
        super().clear()
        self._outcomes: dict[int, Outcome] = {}  # by the beginnings of the stops
        self.numbers = 0
        self._early: tuple[int, float] = -1, 0.0  # stop checked by early(), time of the next check

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """Return the outcomes in the order of their numbers."""
        return tuple(sorted(self._outcomes.values(), key=lambda outcome: outcome.number))

    @property
    def samples(self) -> tuple[Sample, ...]:
        """Return the samples, without those of samples.exclude."""
        return single_samples([o.sample for o in self.outcomes
                               if o.sample and not self.excludes(o)])

    @property
    def rejects(self) -> tuple[Reject, ...]:
        """Return the stops without a sample or with an excluded one, with the reasons."""
        return tuple(o.result if isinstance(o.result, Reject) else
                     Reject(o.result.stamp, f'sample {o.number} is left out by samples.exclude')
                     for o in self.outcomes if o.sample is None or self.excludes(o))

    def excludes(self, outcome: Outcome) -> bool:
        """Return whether samples.exclude contains a sample."""
        return outcome.number in self._config.samples.exclude

    def with_base(self, config: Config) -> Config:
        """Return the settings with the frame of the poses as the base, if they name none."""
        return config if config.robot_base_frame else replace(
            config, robot_base_frame=self.base_frame)

    def finish(self) -> list[Sample | Reject]:
        """
        Return what all remaining stops give, including the current one.

        Raises InputError when messages of two frames came on one topic.
        """
        return [self.put(self.outcome(stop, result_of(stop, self._config))).result
                for stop in self.rest()]

    def early(self) -> Stop | None:
        """
        Return the current stop as soon as it has enough profiles for a sample.

        At first it needs MOST_PROFILES. A stop without a sample is returned a few more times,
        later and later, as the cause may be gone. passed() returns it again when it is over.
        """
        sampling, stood = self._config.sampling, self._finder.stood
        first = (sampling.still_time + 2 * sampling.settle_time) * NS
        began, next_check = self._early
        if began != self._finder.began:
            began, next_check = self._early = self._finder.began, first
        if sampling.moving or stood < next_check:
            return None
        self._early = began, CHECK_LATER * next_check
        stop, known = self.standing(), self._outcomes.get(began)
        if stop is None or (known and known.sample):
            return None
        enough = MOST_PROFILES if next_check == first else 1 if stood < PATIENCE else 0
        return stop if len(stop.steady(self._config)) >= enough else None

    def outcome(self, stop: Stop, result: Sample | Reject) -> Outcome:
        """Return the numbered outcome of a stop; a duplicate pose gives no sample."""
        before = self._outcomes.get(stop.began)
        others = [o for o in self.outcomes if o is not before and not self.excludes(o)]
        why = '' if isinstance(result, Reject) or result.moving else duplicate_pose(
            result, others, self._config)
        return Outcome(before.number if before else self.numbers + 1, stop,
                       Reject(result.stamp, why) if why else result, why)

    def put(self, outcome: Outcome, over: bool = True) -> Outcome:
        """Store and return the outcome of a stop in place of an earlier one."""
        self._outcomes[outcome.stop.began] = outcome
        self.numbers = max(self.numbers, outcome.number)
        if over:
            self.leave(outcome.stop)
        return outcome

    def remove(self, outcome: Outcome) -> None:
        """Forget the outcome of a stop; the stop counts as taken."""
        self.leave(outcome.stop)
        self._outcomes.pop(outcome.stop.began, None)

    def restore(self, outcomes: Sequence[Outcome], numbers: int, frame_id: str) -> None:
        """Continue from the stops of an earlier run; numbers: how many were assigned."""
        self.clear()
        self.numbers, self._profile_stream.frame = numbers, frame_id or None
        for outcome in outcomes:
            self.put(outcome)

    def require_stops(self) -> None:
        """Refuse a recording without stops, see StopCollector."""
        if not self.numbers or self.conflict:
            super().require_stops()
