"""
Memory that was freed, given back to the system.

The C library keeps what lies between blocks that are still in use: after a stop of thousands of
messages, of which a few are kept, that is most of it, and it grows from stop to stop.
"""
from __future__ import annotations

import ctypes

TRIM = getattr(ctypes.CDLL(None), 'malloc_trim', None)  # of glibc alone


def give_back() -> None:
    """Give freed memory back to the system, where the C library can; takes milliseconds."""
    if TRIM is not None:
        TRIM(0)
