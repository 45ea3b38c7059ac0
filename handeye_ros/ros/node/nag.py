"""Tells what stands in the way: once, and again while it lasts."""
from __future__ import annotations

from collections.abc import Callable, Iterable
import re
import time

PERIOD = 10.0  # s


class Nag:
    """Repeats a sentence every PERIOD while it lasts, whatever the numbers in it."""

    def __init__(self, say: Callable[[str], object]) -> None:
        """Start with nothing said; say: where the sentences go."""
        self._say = say
        self._said: dict[str, float] = {}

    def tell(self, sentences: Iterable[str], now: float | None = None) -> None:
        """Say what is new, or was said long ago; what is not among the sentences is over."""
        now = time.monotonic() if now is None else now
        lasting: dict[str, float] = {}
        for sentence in sentences:
            key = re.sub(r'[-+.\d]+', '#', sentence)
            lasting[key] = self._said.get(key, -PERIOD)
            if now - lasting[key] >= PERIOD:
                self._say(sentence)
                lasting[key] = now
        self._said = lasting
