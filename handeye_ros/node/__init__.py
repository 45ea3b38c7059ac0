# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The node: streams, services, messages."""
