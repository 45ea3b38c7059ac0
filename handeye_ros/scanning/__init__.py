# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Points in the base from a calibration: scans, and seams in them."""
