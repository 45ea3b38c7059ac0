# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Simulated recordings with known truth, without ROS.

`simulate` of `recording` renders profiles and poses; `simulate_samples` makes the features
directly. `scenario` has the cells, also those with the faults of real ones, and `tables` makes
files of measured values.
"""
