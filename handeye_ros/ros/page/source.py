"""What a page shows and does, as its server knows it: plain values and functions."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
import json
from typing import Any

Act = Callable[[Mapping[str, Any]], tuple[bool, str]]
Read = Callable[[Mapping[str, str]], Any]


@dataclass(frozen=True)
class Source:
    """
    What the page shows and does.

    tell: plain values, gathered when called; acts: the buttons by name, each called with the
    values of its request, returns whether it succeeded and what to say; slow: those that may
    take long, and keep none of the others waiting; reads: what is asked for, by name, each called
    with the values of its query: plain values, or name and text of a file.
    """

    tell: Callable[[], Mapping[str, Any]]
    acts: Mapping[str, Act]
    slow: frozenset[str] = frozenset()
    reads: Mapping[str, Read] = field(default_factory=dict)


def object_of(text: bytes) -> dict[str, Any] | None:
    """Return what a JSON text holds if that is an object."""
    try:
        found = json.loads(text or b'{}')
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def plain(value: Any) -> Any:
    """Return plain values without infinities and NaN, which JSON does not know."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if abs(value) < float('inf') else None
    return value
