# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The report of a calibration: verdict, scene, residuals, profiles and use of an answer.

The file is complete: it opens without a network.
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import math
from pathlib import Path
from typing import Any

from handeye_ros import config as configuration
from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, Calibration, EdgePoint, FaceLine, Feature
from handeye_ros.output import image, page, style, write_whole
from handeye_ros.results import exports, table
from handeye_ros.results.evidence import (
    config_of,
    Evidence,
    in_plane,
    stated_noise,
    StopSnapshot,
    verdict,
)
from handeye_ros.results.scene import in_sensor, legend, scene
from handeye_ros.results.verification_file import COLUMNS, Verified
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
import numpy as np

BLUE, ORANGE, RED, GREY = '#1f6fb4', '#e07b00', '#c62828', '#777777'
MOST_POINTS = 320  # of a profile in its plot
BINS = 31
AUTOMATIC: Mapping[str, float] = {}  # margins; matplotlib then draws twice
PROFILE_MARGINS = {'left': 0.19, 'right': 0.97, 'bottom': 0.2, 'top': 0.96}  # many plots: fast



def write(calibration: Calibration, evidence: Evidence, path: Path,
          verified: Sequence[Verified] = ()) -> Path:
    """Write the report of a calibration; return its absolute path. Raises UnwritableError."""
    path = path.expanduser().absolute()
    write_whole(path, html(calibration, evidence, verified))
    return path


def html(calibration: Calibration, evidence: Evidence, verified: Sequence[Verified] = ()) -> str:
    """Return the text of the report; verified: verifications to include."""
    config = config_of(calibration)
    used = [stop for stop in evidence.stops if stop.used and stop.features]
    points = in_sensor(in_plane(tuple(f for stop in used for f in stop.features)), config)
    drawn = scene(calibration, evidence.stops, config)
    with style():
        plots = dict(_plots(calibration, evidence, config))
        profiles = [_profile(stop) for stop in evidence.stops]
    return page(
        'report.html', c=calibration, verdict=verdict(calibration, evidence, points),
        transform=list(table.transform_rows(calibration)),
        facts=list(table.facts(calibration)), weakest=table.weakest(calibration.quality),
        details=list(table.details(calibration.target)), matrix=exports.matrix(calibration),
        scene=drawn, legend=legend(drawn['parts']), plots=plots, profiles=profiles,
        refused=[report for report in calibration.samples if not report.used],
        settings=configuration.flatten(config).items(), verified=verified, columns=COLUMNS,
        inputs=[', '.join(f'{key} {value}' for key, value in item.items())
                for item in calibration.provenance.get('inputs', ())],
        uses=[('URDF or xacro', exports.joint(calibration)),
              ('ROS 2, shell', exports.command(calibration))])


def _plots(calibration: Calibration, evidence: Evidence, config: Config
           ) -> Iterator[tuple[str, str]]:
    """Yield the plots with data, by name."""
    used = [stop for stop in evidence.stops if stop.used and stop.features]
    if not used:
        return
    yield 'coverage', _coverage_plot(used)
    solved = [stop for stop in used if len(stop.residuals)]
    if solved:
        yield 'residuals', _residuals_plot(solved)
        if len(evidence.sweep):
            yield 'sweep', _sweep_plot(evidence.sweep)
        points = np.concatenate([in_plane(stop.features) for stop in solved])
        middle = in_sensor(points.mean(axis=0)[None], config)[0]
        arm = calibration.T_flange_sensor @ np.append(middle, 1.0)
        yield 'histogram', _histogram_plot(
            solved, stated_noise(config.noise, float(np.linalg.norm(arm[:3]))))


def _profile(stop: StopSnapshot) -> dict[str, Any]:
    rms = float(np.sqrt((stop.residuals ** 2).mean())) if len(stop.residuals) else None
    return {'number': stop.number, 'used': stop.used, 'reason': stop.reason,
            'residual': None if rms is None else f'{rms * 1e3:.3f} mm',
            'image': _profile_plot(stop) if len(stop.points) else ''}


def _figure(width: float, height: float, columns: int = 1,
            margins: Mapping[str, float] = AUTOMATIC) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), layout=None if margins else 'constrained')
    FigureCanvasSVG(figure)
    if margins:
        figure.subplots_adjust(**margins)
    return figure, figure.subplots(1, columns)


def _residuals_plot(stops: Sequence[StopSnapshot]) -> str:
    """Return the plot of RMS residuals of stops, in the fit and left out."""
    used = [stop for stop in stops if len(stop.residuals)]
    figure, ax = _figure(7, 2.6)
    positions = np.arange(len(used))
    for shift, color, label, values in (
            (-0.2, BLUE, 'in the fit', [stop.residuals for stop in used]),
            (0.2, ORANGE, 'left out of the fit', [stop.left_out for stop in used])):
        heights = [1e3 * float(np.sqrt((v ** 2).mean())) for v in values]
        ax.bar(positions + shift, heights, 0.4, color=color, label=label)
    ax.set_xticks(positions, [str(stop.number) for stop in used], fontsize=7)
    ax.set_xlabel('stop')
    ax.set_ylabel('RMS residual (mm)')
    ax.legend(loc='upper right', ncols=2)
    return image(figure)


def _sweep_plot(samples: Array) -> str:
    """Return the plot of a sweep's residuals over time and speed; samples: as in Evidence."""
    time, rms, speed = samples.T
    figure, (by_time, by_speed) = _figure(7, 2.6, 2)
    for ax, x, label in ((by_time, time, 'time (s)'), (by_speed, 1e3 * speed, 'speed (mm/s)')):
        ax.plot(x, 1e3 * rms, '.', color=BLUE, ms=4)
        ax.set(xlabel=label, ylabel='RMS residual (mm)', ylim=(0, None))
    return image(figure)


def _histogram_plot(stops: Sequence[StopSnapshot], stated: float) -> str:
    """Return the histogram of residuals with a normal density (1 sigma, metres)."""
    values = 1e3 * np.concatenate([stop.residuals for stop in stops])
    reach = max(float(np.quantile(np.abs(values), 0.999)), 3e3 * stated)
    bins = np.linspace(-reach, reach, BINS + 1)
    figure, ax = _figure(7, 2.6)
    ax.hist(values, bins, density=True, color=BLUE, alpha=0.7,
            label=f'residuals, RMS {np.sqrt((values ** 2).mean()):.3f} mm')
    x = np.linspace(-reach, reach, 201)
    sigma = 1e3 * stated
    ax.plot(x, np.exp(-(x / sigma) ** 2 / 2) / sigma / math.sqrt(2 * math.pi), color=ORANGE,
            label=f'stated noise, 1 sigma {sigma:.3f} mm')
    ax.set_xlabel('residual (mm)')
    ax.set_ylabel('share per mm')
    ax.legend(loc='upper right')
    return image(figure)


def _coverage_plot(stops: Sequence[StopSnapshot]) -> str:
    """Return the plot of positions in the field of view, and of rotations of the sensor."""
    used = [stop for stop in stops if stop.used]
    points = 1e3 * np.concatenate([in_plane(stop.features) for stop in used])
    R = np.array([stop.T_mount[:3, :3] for stop in used])
    middle = se3.mean_pose(np.array([stop.T_mount for stop in used]))[:3, :3]
    turns = np.degrees(se3.log_rotation(R @ middle.T))
    figure, (field_axes, rotation_axes) = _figure(7, 3.1, 2)
    field_axes.plot(*points.T, '.', color=BLUE, ms=4)
    field_axes.set(xlabel='along the laser line (mm)', ylabel='range (mm)',
                   title='Field of view that was used')
    field_axes.invert_yaxis()
    dots = rotation_axes.scatter(turns[:, 0], turns[:, 1], c=turns[:, 2], s=22, cmap='viridis')
    rotation_axes.set(xlabel='turn about x (degrees)', ylabel='turn about y (degrees)',
                      aspect='equal', adjustable='datalim', title='Rotations from their mean')
    figure.colorbar(dots, ax=rotation_axes, label='turn about z (degrees)')
    return image(figure)


def _profile_plot(stop: StopSnapshot) -> str:
    """Return the plot of a profile of a stop with its features."""
    points = 1e3 * stop.points[np.isfinite(stop.points).all(axis=1)]
    points = points[::max(1, len(points) // MOST_POINTS)]
    figure, ax = _figure(3.2, 2.3, margins=PROFILE_MARGINS)
    ax.plot(*points.T, '.', color=GREY if stop.used else RED, ms=1.5)
    for feature in stop.features:
        _draw(ax, feature)
    ax.set(xlabel='along the line (mm)', ylabel='range (mm)')
    ax.invert_yaxis()
    return image(figure)


def _draw(ax: Any, feature: Feature) -> None:
    if isinstance(feature, FaceLine):
        half_length = math.sqrt(3) * feature.spread * feature.direction  # of evenly spread points
        ends = 1e3 * np.array([feature.centre - half_length, feature.centre + half_length])
        ax.plot(*ends.T, color=BLUE, lw=1.6)
    elif isinstance(feature, EdgePoint):
        ax.plot(*(1e3 * feature.point), 'o', mfc='none', color=ORANGE, ms=7, mew=1.6)
    elif isinstance(feature, Arc):
        ax.plot(*(1e3 * feature.points).T, color=BLUE, lw=1.6)
