# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Buffer of the profiles that the current and pending stops can use, bounded in memory."""
from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator
from copy import copy
from dataclasses import replace
from typing import Self

from handeye_ros.data import AnyProfile, RawProfile
import numpy as np

MOST_BACK = 0.2  # of the way forth: behind a step the columns may run back by less


class ProfileBuffer:
    """Profiles in the order of their stamps; if full, the oldest are dropped and counted."""

    def __init__(self, most_bytes: int = 256_000_000) -> None:
        """Start with none; by default 8 s of 2000 profiles a second of 1280 points fit in."""
        self._most = most_bytes
        self.items: list[AnyProfile] = []
        self._bytes = 0
        self._dropped = 0

    def __len__(self) -> int:
        """Return the number of profiles."""
        return len(self.items)

    @property
    def warnings(self) -> Iterator[str]:
        """Yield a sentence with the number of dropped profiles, if any."""
        if self._dropped:
            yield (f'dropped {self._dropped} profiles, the oldest of their stops: a stop may take '
                   f'{self._most / 1e6:.0f} MB')

    def copied(self) -> Self:
        """Return an independent copy."""
        other = copy(self)
        other.items = list(self.items)
        return other

    def add(self, profiles: Iterable[AnyProfile]) -> None:
        """Add the next profiles."""
        for profile in profiles:
            self.items.append(in_line_order(profile))
            self._bytes += _held(profile)
        if self._bytes > self._most:
            # more than has to go: to shift what is left for every single one takes its time
            excess, drop = self._bytes - 0.95 * self._most, 0
            while excess > 0 and drop < len(self.items) - 1:
                excess -= _held(self.items[drop])
                drop += 1
            self._dropped += drop
            self._forget(slice(0, drop))

    def keep(self, first: int, last: int) -> None:
        """Drop all profiles outside two stamps."""
        end = bisect_right(self.items, last, key=_stamp)
        self._forget(slice(end, len(self.items)))
        self._forget(slice(0, bisect_left(self.items, first, key=_stamp)))

    def _forget(self, part: slice) -> None:
        self._bytes -= sum(map(_held, self.items[part]))
        del self.items[part]


def _held(profile: AnyProfile) -> int:
    return profile.held if isinstance(profile, RawProfile) else 0


def _stamp(profile: AnyProfile) -> int:
    return profile.stamp


def in_line_order(profile: AnyProfile) -> AnyProfile:
    """
    Return a profile with its points sorted along the laser line if they are unordered.

    Points in the origin become NaN: drivers publish the origin for missing returns.
    """
    if isinstance(profile, RawProfile):
        return profile  # sorted when it is read
    x = profile.points[:, 0]
    missing = (x == 0) & (profile.points[:, 1] == 0)
    if missing.any():
        points = np.where(missing[:, None], np.nan, profile.points)
        profile, x = replace(profile, points=points), points[:, 0]
    placed = np.isfinite(x).nonzero()[0]
    steps = np.diff(x[placed])
    forth, back = steps[steps > 0].sum(), -steps[steps < 0].sum()
    if min(forth, back) <= MOST_BACK * max(forth, back):
        return profile
    order = placed[np.argsort(x[placed], kind='stable')]
    intensity = None if profile.intensity is None else profile.intensity[order]
    return replace(profile, points=profile.points[order], intensity=intensity)
