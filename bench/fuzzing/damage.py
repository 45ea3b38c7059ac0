"""Bytes that are damaged, and numbers that hostile messages hold."""
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import struct

import numpy as np

SIZES = (0, 1, 2, 7, 12, 60, 2 ** 8, 2 ** 16, 2 ** 31 - 1, 2 ** 31, 2 ** 32 - 12, 2 ** 32 - 1)
HOSTILE = (b'1e999', b'nan', b'-.inf', b'[' * 2000, b'{' * 500, b'&a [*a]', b'9' * 400, b'\x00',
           b'!!python/object/apply:os.system [id]', b'\xff\xfe', b'- ' * 300, b': ', b'~', b'"',
           b'\n\n', b'true', b'0x7fffffffffffffffff', b'2026-13-45', b'\xc3', b'<<: *b')
Case = Callable[[np.random.Generator, Path], None]


def size(rng: np.random.Generator) -> int:
    """Return a number that a size may be, or must not."""
    return int(rng.choice(SIZES)) if rng.random() < 0.7 else int(rng.integers(0, 2 ** 32))


def damaged(data: bytes, rng: np.random.Generator, text: bool = False) -> bytes:
    """Return bytes with some overwritten, cut, doubled or put in."""
    found = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(0, len(found) + 1))
        length = int(rng.integers(1, 40))
        kind = int(rng.integers(0, 6))
        if kind == 0:
            found[at:at + length] = rng.bytes(length)
        elif kind == 1:
            del found[at:]
        elif kind == 2:
            del found[at:at + length]
        elif kind == 3:
            found[at:at] = found[at:at + length]
        elif kind == 4 or not text:
            found[at:at + 8] = struct.pack('<Q', int(rng.choice(np.array(SIZES, np.uint64))))
        else:
            found[at:at] = HOSTILE[int(rng.integers(0, len(HOSTILE)))]
    return bytes(found)
