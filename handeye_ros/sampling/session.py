# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The session: all stops of a recording or of a running node, and what each gives.

The same Session takes the messages of a bag and those of live topics (see collector.py).
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
import math

from handeye_ros import se3, targets
from handeye_ros.config import Config
from handeye_ros.data import Reject, Sample
from handeye_ros.sampling.collector import StopCollector
from handeye_ros.sampling.features import result_of
from handeye_ros.sampling.stops import MOST_PROFILES, NS, Stop
from handeye_ros.sampling.sweep import passes_expanded
import numpy as np

PATIENCE = 2 * NS  # of a stop without any profile, before it is said that it gives no sample
CHECK_LATER = 1.4  # factor of the time after which a stop without a sample is tried again


def with_result(stop: Stop, config: Config) -> Stop:
    """Return the stop with what it gives with a configuration."""
    return replace(stop, result=replace(stop.result, stamp=stop.load(config).start)
                   if stop.refused else result_of(stop, config))


def duplicate_pose(sample: Sample, others: Iterable[Stop], config: Config) -> str:
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
        self._stops: dict[int, Stop] = {}  # by their beginnings
        self.numbers = 0
        self._next_check: tuple[int, float] = -1, 0.0  # beginning of a stop, time in it

    @property
    def stops(self) -> tuple[Stop, ...]:
        """Return the evaluated stops in the order of their numbers."""
        return tuple(sorted(self._stops.values(), key=lambda stop: stop.number))

    @property
    def samples(self) -> tuple[Sample, ...]:
        """Return the samples, without those of samples.exclude."""
        return passes_expanded([o.sample for o in self.stops
                               if o.sample and not self.excludes(o)])

    @property
    def rejects(self) -> tuple[Reject, ...]:
        """Return the stops without a sample or with an excluded one, with the reasons."""
        return tuple(o.result if isinstance(o.result, Reject) else
                     Reject(o.result.stamp, f'sample {o.number} is left out by samples.exclude')
                     for o in self.stops if o.sample is None or self.excludes(o))

    def excludes(self, stop: Stop) -> bool:
        """Return whether samples.exclude contains the sample of a stop."""
        return stop.number in self._config.samples.exclude

    def with_base(self, config: Config) -> Config:
        """Return the settings with the frame of the poses as the base, if they name none."""
        return config if config.robot_base_frame else replace(
            config, robot_base_frame=self.base_frame)

    def finish(self) -> list[Sample | Reject]:
        """
        Return what all remaining stops give, including the current one.

        Raises InputError when messages of two frames came on one topic.
        """
        return [self.put(self.numbered(stop, result_of(stop, self._config))).result
                for stop in self.rest()]

    def current_if_ready(self) -> Stop | None:
        """
        Return the current stop as soon as it has enough profiles for a sample.

        At first it needs MOST_PROFILES. A stop without a sample is returned a few more times,
        later and later, as the cause may be gone. passed() returns it again when it is over.
        """
        sampling, stood = self._config.sampling, self._finder.stood
        first = (sampling.still_time + 2 * sampling.settle_time) * NS
        began, next_check = self._next_check
        if began != self._finder.began:
            began, next_check = self._next_check = self._finder.began, first
        if sampling.mode != 'still' or stood < next_check:
            return None
        self._next_check = began, CHECK_LATER * next_check
        stop, known = self._finder.current(), self._stops.get(began)
        if stop is None or self.is_taken(stop) or (known and known.sample):
            return None
        stop = self._with_profiles(stop)
        enough = MOST_PROFILES if next_check == first else 1 if stood < PATIENCE else 0
        return stop if len(stop.steady(self._config)) >= enough else None

    def numbered(self, stop: Stop, result: Sample | Reject) -> Stop:
        """Return a stop with its number and result; a duplicate pose gives no sample."""
        before = self._stops.get(stop.began)
        others = [other for other in self.stops
                  if other is not before and not self.excludes(other)]
        why = '' if isinstance(result, Reject) or result.moving else duplicate_pose(
            result, others, self._config)
        return replace(stop, number=before.number if before else self.numbers + 1,
                       result=Reject(result.stamp, why, final=True) if why else result)

    def put(self, stop: Stop, over: bool = True) -> Stop:
        """Store and return an evaluated stop, in place of an earlier part of it."""
        self._stops[stop.began] = stop
        self.numbers = max(self.numbers, stop.number)
        if over:
            self.leave(stop)
        return stop

    def remove(self, stop: Stop) -> None:
        """Forget the result of a stop; it counts as taken."""
        self.leave(stop)
        self._stops.pop(stop.began, None)

    def restore(self, stops: Sequence[Stop], numbers: int, frame_id: str) -> None:
        """Continue from the stops of an earlier run; numbers: how many were assigned."""
        self.clear()
        self.numbers, self._profile_stream.frame = numbers, frame_id or None
        for stop in stops:
            self.put(stop)

    def require_stops(self) -> None:
        """Refuse a recording without stops, see StopCollector."""
        if not self.numbers or self.conflict:
            super().require_stops()
