#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Makes the recordings in bags/ again: `.venv/bin/python tools/make_bags.py [FOLDER]`."""
from __future__ import annotations

from pathlib import Path
import sys

from handeye_ros.cli.simulated import write_simulated

# bag: scenario, seed
BAGS = {
    'plate': ('small_plate', 1),
    'sphere': ('small_sphere', 2),
    'one_orientation': ('small_one_orientation', 3),
    'inverted_poses': ('small_inverted_poses', 4),
    'line': ('small_line', 5),
    'plane': ('small_plane', 6),
    'plate_sweep': ('small_plate_sweep', 8),
    'tracker': ('small_tracker', 7),
    'arm': ('small_arm', 8),
}


def main(folder: Path) -> None:
    """Make every bag in the folder; what is there already is replaced."""
    for bag, (name, seed) in BAGS.items():
        made = write_simulated(name, seed, folder / bag, force=True)
        size = sum(file.stat().st_size for file in (folder / bag).iterdir())
        print(f'{folder / bag}: {made}, {size / 1e6:.2f} MB')


if __name__ == '__main__':
    main(Path(sys.argv[1] if sys.argv[1:] else Path(__file__).parents[1] / 'bags'))
