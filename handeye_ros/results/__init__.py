# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What an answer says: its quality, the table and the HTML report."""
