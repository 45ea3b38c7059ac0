"""Memory of the node: what was freed goes back to the system."""
from __future__ import annotations

import os
from pathlib import Path

from handeye_ros.ros.node.worker import give_back, TRIM
import pytest

MESSAGES, SIZE = 4000, 15_000


def resident() -> int:
    """Return the resident memory of this process in bytes."""
    pages = Path('/proc/self/statm').read_text(encoding='utf-8').split()[1]
    return int(pages) * os.sysconf('SC_PAGE_SIZE')


@pytest.mark.skipif(TRIM is None, reason='this C library gives back by itself, or not at all')
def test_what_lies_between_kept_messages_is_given_back() -> None:
    messages = [bytes([i % 256]) * SIZE for i in range(MESSAGES)]
    kept = messages[::50]
    before = resident()
    del messages
    give_back()
    assert before - resident() > 0.7 * MESSAGES * SIZE
    assert all(len(message) == SIZE for message in kept)
