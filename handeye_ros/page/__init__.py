# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The browser page at the cell: the state of the node, and its services as buttons."""
