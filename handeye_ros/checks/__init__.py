# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What is doubted before an answer is given: refused, estimated, or allowed for in the covariance.

Refusals without a cause are in refusals.py. All other files are causes: assumptions that are
changed, one by one, by one engine (hypotheses.py), in the order of causes.py. These refuse without
it: surfaces.py, which compares the stops among themselves, and what a refined answer estimates
itself (`require_steady_clocks`, `require_one_scale`, `require_no_sure_move`). All know samples,
estimates and the stops of a session, whose profiles they may read again, and no file. `handeye
check`, of a calibration made earlier, is verification/check.py.
"""
