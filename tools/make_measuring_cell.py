"""
Writes the recordings of a simulated cell that is calibrated and then measures.

usage: .venv/bin/python tools/make_measuring_cell.py DIR [SEED]

DIR/plate is for the calibration, DIR/ball_1 and DIR/ball_2 are the ends of a ball bar (radius
20 mm, 200 mm apart), DIR/pass_1 to DIR/pass_7 a scan of a tooth gauge (pitch 15 mm, height 5 mm,
flanks of 45 degrees).
"""
from __future__ import annotations

from pathlib import Path
import sys

from handeye_ros.ros.bags import bag_write
from handeye_ros.simulate.measuring import measuring_cell
import numpy as np


def main() -> None:
    folder = Path(sys.argv[1])
    cell = measuring_cell(np.random.default_rng(int(sys.argv[2]) if len(sys.argv) > 2 else 0))
    for name, recording in cell.recordings.items():
        bag_write.write(folder / name, recording.profiles, recording.poses)
        print(f'wrote {folder / name}: {len(recording.profiles)} profiles')


if __name__ == '__main__':
    main()
