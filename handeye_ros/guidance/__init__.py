# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The next pose that helps most.

What is determined so far, what is missing, and poses within the limits of the robot.
"""
