# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
When the robot stood still, and what it saw there.

Streams of profiles and poses become stops and samples, or passes of a moving robot; the session
holds them.
"""
