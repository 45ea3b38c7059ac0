# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Points in the base from a calibration: scans, and seams in them."""

DEFAULT_WIDEST = 0.012  # m: the largest distance between the edges of a seam
DEFAULT_TOWARDS = (0.0, 0.0, -1.0)  # the tool approaches a seam from above
