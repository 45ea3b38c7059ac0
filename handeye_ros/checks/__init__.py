# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What is doubted before an answer is given: refused, freed, or allowed for in the covariance.

Refusals without a cause are in refusals.py. All other files are causes: assumptions that are
changed, one by one, by one engine (hypotheses.py), in the order of causes.py. They know samples,
estimates and the stops of a session, whose profiles they may read again, and no file.
"""
