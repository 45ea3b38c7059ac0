# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The files of an answer and what they say: calibration.yaml, exports, table, report, scene."""
