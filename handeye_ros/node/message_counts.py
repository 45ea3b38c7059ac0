# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What has come on a topic: the numbers of its messages, and what is wrong with them."""
from __future__ import annotations

from collections import deque
from itertools import takewhile
import time
from typing import Any

SILENCE_TIME = 2.0  # s without a message until it is reported
BAD_IN_A_ROW = 3  # consecutive invalid messages until they are reported,
BAD_SHARE = 0.01  # or such a share of the last RECENT, or of the messages lost in transit
RECENT = 1000
VALID, MALFORMED, LOST = 'valid', 'malformed', 'lost'  # what a message was


class MessageCount:
    """
    Counts valid items of one kind (profile, pose), and its malformed and lost messages.

    A message may hold several items, as rows: the shares that `state` compares are then too small.
    reason: of the last malformed message; stamp: of the last valid item (ns), 0 before.
    """

    def __init__(self, kind: str) -> None:
        """Start without messages."""
        self.kind, self.count, self.malformed, self.lost = kind, 0, 0, 0
        self.reason, self.stamp = '', 0
        self._recent, self._received = deque[str](maxlen=RECENT), time.monotonic()

    def add(self, stamp: int) -> None:
        """Count a valid item; stamp: as it is used, with time_offset, or of its receipt (ns)."""
        self.count, self.stamp, self._received = self.count + 1, stamp, time.monotonic()
        self._recent.append(VALID)

    def add_malformed(self, reason: str) -> None:
        """Count an invalid message."""
        self.malformed, self.reason = self.malformed + 1, reason
        self._recent.append(MALFORMED)

    def add_lost(self, number: int) -> None:
        """Count messages that were lost on their way."""
        self.lost += number
        self._recent.extend([LOST] * min(number, RECENT))

    def forget_malformed(self) -> None:
        """Forget the invalid messages, as they were read with other settings."""
        self.malformed, self.reason = 0, ''
        self._recent.clear()

    @property
    def silence(self) -> float:
        """Return the seconds since the last valid item, or since the start."""
        return time.monotonic() - self._received

    def state(self, topic: str, obstacle: str) -> dict[str, Any]:
        """
        Return what has come on a topic; obstacle: why nothing arrives, where it is known.

        count: number of valid items; malformed, lost: of invalid messages, and of those lost on
        their way; reason: of the last invalid one; age: seconds since the last valid item, or
        since the start; flows: whether they come; trouble: that many of the last, or all of them,
        are invalid or lost, or none arrive; or ''.
        """
        kind, count, recent = self.kind, self.count, [*self._recent]
        sentences, age, total = [], self.silence, len(recent)
        in_a_row = len([*takewhile(MALFORMED.__eq__, reversed(recent))])
        malformed, lost = recent.count(MALFORMED), recent.count(LOST)
        if in_a_row >= BAD_IN_A_ROW or (
                malformed >= max(BAD_IN_A_ROW, BAD_SHARE * (total - lost))):
            which = (f'the last {in_a_row}' if in_a_row >= BAD_IN_A_ROW else
                     f'{malformed} of the last {total}')
            sentences.append(f'{which} {kind}s cannot be used; the last reason: {self.reason}')
        if lost > BAD_SHARE * total:
            sentences.append(f'{lost} of the last {total} {kind}s were lost on their way: let the '
                             'driver publish them reliably, with a queue for as many as come at '
                             'once, or fewer or smaller ones')
        if not sentences and age >= SILENCE_TIME:
            sentences.append(f'{"no more" if count else "no"} {kind}s on {topic} for {age:.0f} s'
                             + (f' ({obstacle})' if obstacle else ''))
        return {'kind': kind, 'topic': topic, 'count': count, 'malformed': self.malformed,
                'reason': self.reason, 'lost': self.lost, 'age': age,
                'flows': count > 0 and age < SILENCE_TIME,
                'trouble': '; '.join(sentences)}


def new_counts() -> dict[str, MessageCount]:
    """Return counts of profiles and poses, by kind (profile, pose)."""
    return {kind: MessageCount(kind) for kind in ('profile', 'pose')}
