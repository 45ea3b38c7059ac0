# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The stated model of the estimator (docs/estimator.md) and its solution.

Problem, nuisance parameters, noise, robust start, covariance. Names no target:
a target gives its conditions and blocks as a `Target` (target.py).
"""
