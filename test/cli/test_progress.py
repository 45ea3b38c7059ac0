# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Long work tells a terminal how far it is; test_cli.py sees that a pipe is told nothing."""
from __future__ import annotations

import os
import pty
import re
import subprocess
import sys

from command import PLATE, ROOT


def test_a_terminal_is_reported_what_is_done(tmp_path) -> None:
    arguments = ['solve', ROOT / 'bags' / 'plate', '--config', PLATE, '--out', tmp_path]
    ours, theirs = pty.openpty()
    process = subprocess.Popen([sys.executable, '-m', 'handeye_ros', *map(str, arguments)],
                               cwd=ROOT, stdout=subprocess.DEVNULL, stderr=theirs,
                               env={**os.environ, 'TERM': 'xterm'})
    os.close(theirs)
    result = b''
    while part := read(ours):
        result += part
    assert process.wait() == 0
    text = re.sub(r'\x1b\[[0-9;?]*[a-zA-Z]', '', result.decode())
    assert re.search('reading the recording .* [0-9]+%', text) and 'solving' in text


def read(terminal: int) -> bytes:
    """Return what has come; nothing where the other side has ended."""
    try:
        return os.read(terminal, 4096)
    except OSError:
        return b''
