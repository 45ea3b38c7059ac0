# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What an answer says, and its files: table, report, scene, exports; those of a verification."""
