# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What an answer says, in files and printed.

calibration.yaml and its exports, kinematics.yaml, truth.yaml; tables, the report, its scene;
templates of all pages.
"""
