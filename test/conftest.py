"""Isolation and repeatability, for all tests."""
from __future__ import annotations

from collections.abc import Iterator
import os
import signal
from typing import Any

from hypothesis import settings
import pytest

# Before anything imports ROS: what a test starts is seen by no other process of this machine or
# the network. Of each worker of pytest-xdist its own; 0 is everyone's default.
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 101)

# In the background of a shell SIGINT is ignored, and so it would be by what the tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The same examples every time, however slow the machine. To look for new ones:
# HYPOTHESIS_PROFILE=explore make test
settings.register_profile('repeatable', derandomize=True, deadline=None, database=None)
settings.register_profile('fewer', settings.get_profile('repeatable'), max_examples=25)
settings.register_profile('explore', deadline=None, max_examples=1000, print_blob=True)
settings.load_profile(os.environ.get('HYPOTHESIS_PROFILE', 'repeatable'))


@pytest.fixture
def client() -> Iterator[Any]:
    """Give a ROS node in the process of the test (ros_helpers.Client)."""
    from ros_helpers import Client
    client = Client()
    yield client
    client.close()
