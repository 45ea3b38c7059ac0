# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What one profile shows: straight pieces, faces and edges, arcs.

Takes the points of one profile or of a stop, and knows no robot.
"""
