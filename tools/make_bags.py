#!/usr/bin/env python3
"""Makes the recordings in bags/ again: `.venv/bin/python tools/make_bags.py [FOLDER]`."""
from __future__ import annotations

from pathlib import Path
import sys

from handeye_ros.ros import bag_write
from handeye_ros.simulate import SCENARIOS, simulate
from handeye_ros.truth import truth_values
import numpy as np

# bag: scenario, seed
BAGS = {
    'plate': ('small_plate', 1),
    'sphere': ('small_sphere', 2),
    'one_orientation': ('small_one_orientation', 3),
    'inverted_poses': ('small_inverted_poses', 4),
    'line': ('small_line', 5),
    'plane': ('small_plane', 6),
}


def main(folder: Path) -> None:
    """Make every bag in the folder; what is there already is replaced."""
    for bag, (name, seed) in BAGS.items():
        made = simulate(SCENARIOS[name], np.random.default_rng(seed))
        bag_write.write(folder / bag, made.profiles, made.poses, truth=truth_values(made, seed),
                        force=True)
        size = sum(file.stat().st_size for file in (folder / bag).iterdir())
        print(f'{folder / bag}: {len(made.profiles)} profiles, {size / 1e6:.2f} MB')


if __name__ == '__main__':
    main(Path(sys.argv[1] if sys.argv[1:] else Path(__file__).parents[1] / 'bags'))
