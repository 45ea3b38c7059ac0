"""
The messages of one topic as they come: what can belong to it, in the order of the stamps.

A message with a stamp far ahead of the one before may come after a pause, or be one whose
stamp is wrong; the next message tells, so it is held back until then. Believed at once, a
wrong one would make all others late.
"""
from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from copy import copy
from itertools import accumulate
from typing import Generic, TypeVar

from handeye_ros.data import Profile, RawProfile, TimedPose
from handeye_ros.sampling.errors import TwoFramesError
import numpy as np

LARGEST_STEP = 1_000_000_000  # ns; what steps back by less was only reordered on its way

MOST_REASONS = 10  # that are told apart: a damaged topic may give each message another frame
FEW = 3  # messages with wrong stamps that a recording may hold, and
FEW_SHARE = 0.05  # this share of many; more, and it is no longer known which ones are right

Stamped = TypeVar('Stamped', bound=Profile | RawProfile | TimedPose)


class Stream(Generic[Stamped]):
    """
    Passes on the messages of one topic, or drops them with a warning.

    latest: the stamp of the last one passed on, -1 before the first; count: how many were;
    late: whether the last one that came was dropped because it is older than that;
    frame: that of the first one.
    """

    def __init__(self, kind: str) -> None:
        """Start with none; kind: what the messages are, for the warnings."""
        self._kind = kind
        self._held: Stamped | None = None
        self._dropped: Counter[str] = Counter()
        self._first = 0
        self.latest = -1
        self.count = 0
        self.late = False
        self.frame: str | None = None
        self.conflict: TwoFramesError | None = None

    def copied(self) -> Stream[Stamped]:
        """Return another that goes on from here by itself."""
        other = copy(self)
        other._dropped = Counter(self._dropped)
        return other

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return what was dropped, one sentence for each reason."""
        return tuple(f'dropped a {self._kind} {reason} ({count} times)'
                     for reason, count in self._dropped.items())

    @property
    def period(self) -> float:
        """Return the mean time between the messages (s), 0 for one or none."""
        return (self.latest - self._first) * 1e-9 / (self.count - 1) if self.count > 1 else 0.0

    def add(self, item: Stamped, frame: str) -> list[Stamped]:
        """Take the next message; return those that are now known to be right."""
        self.frame = frame if self.frame is None else self.frame
        if frame != self.frame:
            self.conflict = TwoFramesError(self._kind, self.frame, frame)
            known = len(self._dropped) < MOST_REASONS or f'of frame "{frame}"' in self._dropped
            self._dropped[f'of frame "{frame}"' if known else 'of some other frame'] += 1
            return []
        passed = self._judged_by(item)
        self.late = item.stamp <= max(self.latest, self._held.stamp if self._held else -1)
        if self.late:
            self._dropped['whose stamp is not later than the one before: clear the samples if '
                          'a bag was started again'] += 1
        elif item.stamp - self.latest > LARGEST_STEP:
            self._held = item
        else:
            passed.append(self._passed(item))
        return passed

    def believed(self, first: int, last: int) -> list[Stamped]:
        """Return what is held back if its stamp lies between two times that make it credible."""
        held = self._held
        if held is None or not first <= held.stamp <= last:
            return []
        self._held = None
        return [self._passed(held)]

    def _judged_by(self, item: Stamped) -> list[Stamped]:
        """Return what was held back if the next message confirms it."""
        held = self._held
        if held is None:
            return []
        if item.stamp > held.stamp:
            self._held = None
            return [self._passed(held)]
        if held.stamp - item.stamp > LARGEST_STEP:
            self._held = None
            self._dropped['whose stamp lies far ahead of the next one'] += 1
        return []

    def _passed(self, item: Stamped) -> Stamped:
        self._first = self._first if self.count else item.stamp
        self.latest = item.stamp
        self.count += 1
        return item


def in_order(stamps: Sequence[int]) -> list[bool] | None:
    """
    Return which messages of a recording fit the order of the most; None if too many do not.

    stamps: in the order of recording. One that lies within LARGEST_STEP of its place fits.
    """
    if never_falls(stamps):
        return [True] * len(stamps)
    rising = _longest_rising(stamps)
    before = accumulate((s if r else -1 for s, r in zip(stamps, rising, strict=True)), max)
    backwards = [(s if r else None) for s, r in zip(stamps, rising, strict=True)][::-1]
    after = list(accumulate(backwards, _smaller))[::-1]
    fits = [s >= b - LARGEST_STEP and (a is None or s <= a + LARGEST_STEP)
            for s, b, a in zip(stamps, before, after, strict=True)]
    wrong = fits.count(False)
    few = wrong <= max(FEW, FEW_SHARE * len(stamps)) and 2 * wrong < len(stamps)
    return fits if few or not wrong else None


def never_falls(stamps: Sequence[int]) -> bool:
    """Return whether no stamp is earlier than the one before."""
    times = np.array(stamps, np.int64)
    return bool((times[1:] >= times[:-1]).all())


def _smaller(a: int | None, b: int | None) -> int | None:
    return min((v for v in (a, b) if v is not None), default=None)


def _longest_rising(stamps: Sequence[int]) -> list[bool]:
    """Return which values make up the longest subsequence that never falls (patience)."""
    ends: list[int] = []  # the smallest last value of a subsequence of each length
    places: list[int] = []
    for stamp in stamps:
        place = bisect_right(ends, stamp)
        ends[place:place + 1] = [stamp]
        places.append(place)
    chosen, wanted = [False] * len(stamps), len(ends) - 1
    for index in reversed(range(len(stamps))):
        if places[index] == wanted:
            chosen[index], wanted = True, wanted - 1
    return chosen
