# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Recordings: their storage, and conversion of ROS messages to profiles and poses.

Reads mcap and db3 in one pass, also truncated or damaged files, in the layouts of drivers; writes
bags and session files.
"""
