"""Domains that are claimed: two processes never share one."""
from __future__ import annotations

import os

from handeye_ros.node.domain import claimed_domain


def test_claims_are_of_different_domains() -> None:
    first, claim = claimed_domain()
    with claim:
        second, other = claimed_domain()
        other.close()
    assert len({first, second, int(os.environ['ROS_DOMAIN_ID'])}) == 3
