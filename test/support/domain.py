# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A ROS_DOMAIN_ID that no other demo and no test on this machine uses at the same time."""
from __future__ import annotations

import socket

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
