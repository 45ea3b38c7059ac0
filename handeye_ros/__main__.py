# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""`python -m handeye_ros` is `handeye`."""
from handeye_ros.cli import main

main()
