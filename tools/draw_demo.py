#!/usr/bin/env python3
# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Draws what the calibration of bags/plate sees and finds, into docs/figures/demo.png.

usage: .venv/bin/python tools/draw_demo.py [FILE]
"""
from __future__ import annotations

from pathlib import Path
import sys

from handeye_ros import calibrate, Calibration, gather, load_config, read_bag, Sample
from handeye_ros.data import Array, EdgePoint, FaceLine
import matplotlib
import numpy as np

matplotlib.use('agg')
from matplotlib import pyplot as plt  # noqa: E402, I100 - the backend first

ROOT = Path(__file__).parents[1]
LASER, FOUND, SHADE = '#d62728', '#1f77b4', '0.55'
AXIS = 0.03  # length of a drawn axis of the sensor (m)


def in_base(T: Array, points: Array) -> Array:
    """Return points (n, 2) of the sensor plane in the frame of T, in mm."""
    return 1e3 * (points @ T[:3, [0, 2]].T + T[:3, 3])


def draw_profile(ax: plt.Axes, points: Array, sample: Sample) -> None:
    """Draw a profile (n, 2), the face line and the edge point found in it."""
    ax.plot(*points.T * 1e3, '.', color=SHADE, ms=2, label='profile')
    for feature in sample.features:
        if isinstance(feature, FaceLine):
            half = 3 ** 0.5 * feature.spread * feature.direction
            ends = np.array([feature.centre - half, feature.centre + half])
            ax.plot(*ends.T * 1e3, color=FOUND, lw=1.5, label='face')
        elif isinstance(feature, EdgePoint):
            ax.plot(*feature.point * 1e3, 'o', color=LASER, ms=7, label='edge')
    ax.set(xlabel='x along the laser line [mm]', ylabel='z, range [mm]',
           title='One of 18 stops: what is found in a profile')
    ax.invert_yaxis()
    ax.legend(loc='lower right')


def draw_cell(ax: plt.Axes, calibration: Calibration, samples: tuple[Sample, ...]) -> None:
    """Draw the sensor at every stop, and where it saw the plate, in the robot's base."""
    X = calibration.T_flange_sensor
    for sample in samples:
        T = sample.T_base_flange @ X
        for column, colour in ((0, '#d62728'), (1, '#2ca02c'), (2, '#1f77b4')):
            ends = 1e3 * np.array([T[:3, 3], T[:3, 3] + AXIS * T[:3, column]])
            ax.plot(*ends.T, color=colour, lw=1.2)
        for feature in sample.features:
            if isinstance(feature, FaceLine):
                half = 3 ** 0.5 * feature.spread * feature.direction
                ends = in_base(T, np.array([feature.centre - half, feature.centre + half]))
                ax.plot(*ends.T, color=LASER, lw=0.8)
            elif isinstance(feature, EdgePoint):
                ax.plot(*in_base(T, feature.point[None]).T, 'o', color=FOUND, ms=3)
    std = 1e3 * np.sqrt(np.diag(calibration.covariance)[:3]).max()
    ax.set(xlabel='x [mm]', ylabel='y [mm]', zlabel='z [mm]',
           title=f'The sensor at all stops, and the plate it saw\n(position good to {std:.2f} mm, '
                 '1 sigma)')
    ax.set_aspect('equal')
    ax.set_box_aspect(None, zoom=1.15)
    ax.view_init(22, -60)


def main(path: Path) -> None:
    """Calibrate from bags/plate and draw."""
    config = load_config(ROOT / 'config' / 'plate.yaml')
    recording = read_bag(ROOT / 'bags' / 'plate', config)
    calibration = calibrate(recording.profiles, recording.poses, config)
    samples = gather(recording.profiles, recording.poses, config).samples
    points = next(p.points for p in recording.profiles if p.stamp == samples[0].stamp)
    figure = plt.figure(figsize=(10, 4.4))
    draw_profile(figure.add_subplot(1, 2, 1), points, samples[0])
    draw_cell(figure.add_subplot(1, 2, 2, projection='3d'), calibration, samples)
    figure.tight_layout()
    figure.savefig(path, dpi=80, metadata={'Software': None})


if __name__ == '__main__':
    main(Path(sys.argv[1]) if sys.argv[1:] else ROOT / 'docs' / 'figures' / 'demo.png')
