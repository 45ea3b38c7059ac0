# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Isolation and repeatability, for all tests."""
from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
import os
from pathlib import Path
import signal
import socket
from typing import Any

from hypothesis import HealthCheck, settings
import pytest

NOT_RUN = pytest.StashKey[str]()
HIGHEST = 101  # the highest without conflict with Linux's own ports; people use low ones


def claimed_domain() -> tuple[int, socket.socket]:
    """
    Return a free ROS_DOMAIN_ID, and the socket that claims it until it is closed.

    The name of an abstract socket (Linux) is free again when its process ends. Raises OSError if
    all are in use, or the system has no such sockets.
    """
    claim = socket.socket(socket.AF_UNIX)
    for domain in range(HIGHEST, 0, -1):
        try:
            claim.bind(f'\0handeye_ros in domain {domain}')
        except OSError as error:
            last_error = error
        else:
            return domain, claim
    claim.close()
    raise last_error


# Before anything imports ROS: what a test starts is seen by no other process of this machine or
# the network. Each worker of pytest-xdist has a domain of its own.
DOMAIN, CLAIM = claimed_domain()
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['ROS_DOMAIN_ID'] = str(DOMAIN)

# In the background of a shell SIGINT is ignored, and so it would be by what the tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Their failing assertions show both sides too.
pytest.register_assert_rewrite('command', 'recordings')

# The same examples every time, however slow the machine. To look for new ones:
# HYPOTHESIS_PROFILE=explore make test
settings.register_profile('repeatable', derandomize=True, deadline=None, database=None,
                          suppress_health_check=[HealthCheck.too_slow])
settings.register_profile('fewer', settings.get_profile('repeatable'), max_examples=25)
settings.register_profile('explore', deadline=None, max_examples=1000, print_blob=True)
settings.load_profile(os.environ.get('HYPOTHESIS_PROFILE', 'repeatable'))


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Collect what was not run, and why."""
    reasons = Counter(report.longrepr[2].removeprefix('Skipped: ')
                      for report in terminalreporter.stats.get('skipped', ()))
    parts = [f'{count} ({reason})' for reason, count in reasons.items()]
    if 'not thorough' in config.option.markexpr:
        parts.insert(0, 'long tests')
    if parts:
        config.stash[NOT_RUN] = f'Not run: {"; ".join(parts)}. To run all: make test-all'


def pytest_unconfigure(config: pytest.Config) -> None:
    """Print on the last line what was not run."""
    if NOT_RUN in config.stash:
        print(config.stash[NOT_RUN])


@pytest.fixture
def good_bag(tmp_path: Path) -> Path:
    """Return the folder of a bag of recordings.PROFILES and POSES that is in order."""
    from recordings import written
    return written(tmp_path, name='good')


@pytest.fixture
def client() -> Iterator[Any]:
    """Give a ROS node in the process of the test (ros_helpers.Client)."""
    from ros_helpers import Client
    client = Client()
    yield client
    client.close()
