# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Messages of one topic in the order of their stamps; implausible ones are dropped.

A message whose stamp is far ahead may follow a pause, or have a wrong stamp. It is held back until
the next message decides: if a wrong stamp were accepted at once, all later messages would seem
late. If all messages are late for a while, the clock was set back: restart() continues in the new
time.
"""
from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from copy import copy
from operator import attrgetter
from typing import Generic, Self, TypeVar

from handeye_ros.data import NS, Profile, RawProfile, TimedPose
from handeye_ros.errors import DataError, InputError
import numpy as np
from numpy.typing import NDArray

REORDER_TIME = NS  # a smaller step back is only a reordering in transit
LAST_STAMP = 2 ** 63 - 1  # the largest (ns)
# messages in a row that are late, and their time, after which the clock was set back
LATE_COUNT, LATE_TIME = 5, NS // 2
FEW_STRAYS = 3  # messages of another frame, or with wrong stamps: a topic may hold this number,
FEW_SHARE = 0.05  # or a recording this share of many; with more, the right one is unknown
UNMIXED_TIME = 3 * NS  # of messages of one frame, after which others are of the past

by_stamp = attrgetter('stamp')
Stamped = TypeVar('Stamped', bound=Profile | RawProfile | TimedPose)


class Copyable:
    """Something that messages change, of which an independent copy can be made."""

    def copied(self) -> Self:
        """Return an independent copy; messages, which never change, are shared."""
        other = copy(self)
        for name, value in vars(self).items():
            setattr(other, name, value.copied() if isinstance(value, Copyable) else copy(value))
        return other


class Stream(Copyable, Generic[Stamped]):
    """
    Passes on the messages of one topic, or drops them with a warning.

    kind: what they are, for the warnings
    latest: stamp of the last message passed on, -1 before the first
    count: number passed on since the start, or since the clock was set back
    late: whether the last received message was dropped because it is older than `latest`
    repeats: how many last messages have its stamp too
    frame: of the first message; those of others are strays
    successor: the frame that alone has come for UNMIXED_TIME in place of that one, or ''
    step_back: by how much the clock was set back (ns), 0 if it was not
    """

    def __init__(self, kind: str, frame: str | None = None) -> None:
        """Start with none; frame: if it is known before."""
        self.kind = kind
        self._held: Stamped | None = None  # far ahead of the one before it
        self._dropped: Counter[str] = Counter()  # by reason
        self._first = 0  # stamp of the first message that was counted
        self.latest = -1
        self.count = 0
        self.late = False
        self.repeats = 0
        self.frame = frame
        self.successor = ''
        self.step_back = 0
        self._late_stamps: list[int] = []  # stamps of the last messages, if all were far too late
        self._steps_back: list[int] = []  # by how much, each time before (ns)
        self._strays = 0  # with less than UNMIXED_TIME of the first frame between them
        self._last_stray = -1  # `latest` when it came
        self._other, self._other_since = '', -1  # frame of the last stray, since when it is alone

    @property
    def conflict(self) -> InputError | None:
        """Return the error of a topic with two frames, None for a few strays or if they ended."""
        if self._strays <= FEW_STRAYS or self.latest - self._last_stray > UNMIXED_TIME:
            return None
        return two_frames_error(self.kind, str(self.frame), self._other)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return one sentence for each reason for which messages were dropped."""
        dropped = [f'dropped a {self.kind} {reason} ({count} times)'
                   for reason, count in self._dropped.items()]
        steps = self._steps_back
        return (*([f'the clock of the {self.kind}s was set back by {steps[-1] * 1e-9:.1f} s '
                   f'({len(steps)} times): sampling continues in the new time'] if steps else []),
                *dropped)

    @property
    def period(self) -> float:
        """Return the mean time between messages (s), 0 with fewer than two."""
        return (self.latest - self._first) * 1e-9 / (self.count - 1) if self.count > 1 else 0.0

    def add(self, item: Stamped, frame: str) -> list[Stamped]:
        """Add the next message; return it and the one held back, as far as they are confirmed."""
        self.frame = frame if self.frame is None else self.frame
        if frame != self.frame:
            self._count_stray(frame, item.stamp)
            return []
        self._other_since, self.successor = -1, ''
        if self._held and self._held.stamp - item.stamp > REORDER_TIME:
            self._held = None
            self._dropped['whose stamp lies far ahead of the next one'] += 1
        passed = self.release(0, item.stamp - 1)
        newest = max(self.latest, self._held.stamp if self._held else -1)
        self.late = item.stamp < newest
        self.repeats = self.repeats + 1 if item.stamp == newest else 0
        if item.stamp <= newest:
            self._dropped['whose stamp is not later than the one before'] += 1
            self._look_for_step_back(item.stamp)
        else:
            self._held = item
            passed += self.release(0, self.latest + REORDER_TIME)
        return passed

    def _count_stray(self, frame: str, stamp: int) -> None:
        """Count a message of another frame than the first."""
        if self.latest - self._last_stray > UNMIXED_TIME:
            self._strays = 0
        self._strays += 1
        self._last_stray = self.latest
        self._dropped[f'of frame "{frame}"'] += 1
        if frame != self._other or self._other_since < 0:
            self._other, self._other_since = frame, stamp
        self.successor = frame if stamp - self._other_since > UNMIXED_TIME else ''

    def _look_for_step_back(self, stamp: int) -> None:
        """Note a clock that was set back: LATE_COUNT messages, in order, are far too late."""
        late = self._late_stamps
        if self.latest - stamp <= REORDER_TIME or (late and stamp < late[-1]):
            self._late_stamps = []
        if self.latest - stamp > REORDER_TIME:
            self._late_stamps.append(stamp)
        if len(self._late_stamps) >= LATE_COUNT and stamp - self._late_stamps[0] >= LATE_TIME:
            self.step_back = self.latest - self._late_stamps[0]

    def restart(self) -> None:
        """Continue in the time of the next message: the clock was set back, or its offset set."""
        self._steps_back += [self.step_back] if self.step_back else []
        self._held, self.latest, self.late, self.count = None, -1, False, 0
        self._last_stray = -1  # strays before are of the past
        self.step_back, self._late_stamps = 0, []

    def release(self, first: int, last: int) -> list[Stamped]:
        """Pass on, and return, the message held back if its stamp is from first to last (ns)."""
        held = self._held
        if held is None or not first <= held.stamp <= last:
            return []
        self._held, self._late_stamps = None, []
        self._first = self._first if self.count else held.stamp
        self.latest = held.stamp
        self.count += 1
        return [held]


def two_frames_error(kind: str, first: str, second: str) -> InputError:
    """Return the error of two frames on the topic of a kind of messages, profile or pose."""
    why = ('profiles cannot be of one sensor; give each sensor its own topic' if kind == 'profile'
           else 'poses cannot be in one robot base; let only one node publish them, in one frame')
    return InputError(f'the {kind} topic carries two frames, "{first}" and "{second}": the {why}',
                      code='two_frames')


def in_majority_order(stamps: NDArray[np.int64], source: str) -> NDArray[np.bool_]:
    """
    Return which messages fit the order of the majority; raises DataError for two runs.

    stamps: in the order of recording (ns); deviations up to REORDER_TIME from the order fit.
    source: whose they are, in words.
    """
    if (stamps[1:] >= stamps[:-1]).all():
        return np.ones(len(stamps), dtype=bool)
    rising = _longest_rising(stamps.tolist())
    before = np.maximum.accumulate(np.where(rising, stamps, -1))
    after = np.minimum.accumulate(np.where(rising, stamps, LAST_STAMP)[::-1])[::-1]
    fits = (stamps >= before - REORDER_TIME) & (stamps - REORDER_TIME <= after)
    wrong = np.count_nonzero(~fits)
    if wrong and (wrong > max(FEW_STRAYS, FEW_SHARE * len(fits)) or 2 * wrong >= len(fits)):
        back = np.maximum.accumulate(stamps) - stamps
        index = int(np.argmax(back > REORDER_TIME))
        raise DataError(f'the stamps {source} jump back by {back[index] * 1e-9:.1f} s at message '
                        f'{index + 1}: two runs seem to be mixed (a bag recorded in a loop?); '
                        'record one run', code='two_runs')
    return fits


def _longest_rising(stamps: Sequence[int]) -> NDArray[np.bool_]:
    """Return which values make up the longest subsequence that never falls (patience)."""
    ends: list[int] = []  # the smallest last value of a subsequence of each length
    ranks: list[int] = []
    for stamp in stamps:
        rank = bisect_right(ends, stamp)
        ends[rank:rank + 1] = [stamp]
        ranks.append(rank)
    rising, wanted = np.zeros(len(stamps), dtype=bool), len(ends) - 1
    for index in reversed(range(len(stamps))):
        if ranks[index] == wanted:
            rising[index], wanted = True, wanted - 1
    return rising
