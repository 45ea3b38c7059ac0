# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Kinematic calibration of the robot, `handeye kinematics`: joints and axes off their URDF.

The data are those of a hand-eye calibration with joint values; the answer is a corrected URDF with
the calibration that belongs to it. The model of the arm is arm.py.
"""
