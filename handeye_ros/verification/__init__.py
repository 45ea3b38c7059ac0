# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Verification of a calibration: routines on known artefacts, and checks on its own target.

`handeye check` is check.py; what an answer is refused for is in checks/.
"""
