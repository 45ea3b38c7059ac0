"""What has come in so far: counts, ages, what could not be understood, and the clocks."""
from __future__ import annotations

from collections import Counter
import time

KINDS = ('profile', 'pose')
FRESH = 1.0  # s: the clocks are compared where both kinds came so recently
LARGEST_APART = 5.0  # s between the clocks that a slow network or a queue explains


class Arrivals:
    """Counts the messages of a node as they come."""

    def __init__(self) -> None:
        """Start with nothing, now."""
        self.counts = Counter({'profile': 0, 'pose': 0, 'malformed': 0})
        self.bad: Counter[str] = Counter()
        self.last_malformed = ''
        self._reasons: dict[str, str] = {}
        self._latest = dict.fromkeys(KINDS, time.monotonic())
        self._stamps: dict[str, int] = {}

    def came(self, kind: str, stamp: int) -> None:
        """Count a good message; stamp: its own, in ns."""
        self.counts[kind] += 1
        self._latest[kind] = time.monotonic()
        self._stamps[kind] = stamp

    def malformed(self, kind: str, reason: str) -> None:
        """Count a message that could not be understood."""
        self.counts['malformed'] += 1
        self.bad[kind] += 1
        self.last_malformed = self._reasons[kind] = reason

    def mostly_malformed(self, kind: str) -> str:
        """Return how many of a kind cannot be understood, if that is most, and why."""
        bad, good = self.bad[kind], self.counts[kind]
        return (f'{bad} of {bad + good} {kind}s cannot be used; the last reason: '
                f'{self._reasons[kind]}' if bad > good else '')

    def silence(self, kind: str) -> float:
        """Return the seconds since the last good message, or since the start."""
        return time.monotonic() - self._latest[kind]

    @property
    def clocks(self) -> str:
        """Return by how much the clocks of the two kinds differ, if they cannot be one."""
        if any(kind not in self._stamps or self.silence(kind) > FRESH for kind in KINDS):
            return ''
        profile, pose = (self._stamps[kind] * 1e-9 + self.silence(kind) for kind in KINDS)
        apart = profile - pose
        if abs(apart) < LARGEST_APART:
            return ''
        size = f'{abs(apart):.1f} s' if abs(apart) < 3600 else f'{abs(apart) / 3600:.2f} hours'
        return (f'the stamps of the profiles are {size} {"ahead of" if apart > 0 else "behind"} '
                'those of the poses: the clocks of sensor and robot differ; set them to one time '
                '(PTP or NTP), or let one driver stamp as the other does')
