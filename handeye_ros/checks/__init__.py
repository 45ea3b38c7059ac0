# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What is refused and named before an answer is given.

Motion, conventions, moves of the target, shape, misfit: each raises an error that says what
to do. Knows samples, estimates and the stops of a session, and no file and no message.
"""
