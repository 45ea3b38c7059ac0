# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The published algorithms, one file per paper, as their authors wrote them, for comparison.

They take plain arrays, know nothing of the rest of the package and refuse nothing that the
papers do not refuse; where a print is wrong the docstring says so and what was done.
"""
