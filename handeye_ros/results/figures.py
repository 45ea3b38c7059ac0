"""The plots of the report as SVG texts; axes in millimetres and degrees."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from typing import Any

from handeye_ros import se3
from handeye_ros.data import Arc, Array, EdgePoint, FaceLine, Feature
from handeye_ros.output import svg
from handeye_ros.results.evidence import in_plane, StopSnapshot
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
import numpy as np

BLUE, ORANGE, RED, GREY = '#1f6fb4', '#e07b00', '#c62828', '#777777'
MOST_POINTS = 320  # of a profile in its plot
BINS = 31
AUTOMATIC: Mapping[str, float] = {}  # margins; matplotlib then draws twice
PROFILE_MARGINS = {'left': 0.19, 'right': 0.97, 'bottom': 0.2, 'top': 0.96}  # many plots: fast


def _figure(width: float, height: float, columns: int = 1,
            margins: Mapping[str, float] = AUTOMATIC) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), layout=None if margins else 'constrained')
    FigureCanvasSVG(figure)
    if margins:
        figure.subplots_adjust(**margins)
    return figure, figure.subplots(1, columns)


def residuals(stops: Sequence[StopSnapshot]) -> str:
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
    return svg(figure)


def sweep(samples: Array) -> str:
    """Return the plot of a sweep's residuals over time and speed; samples: as in Evidence."""
    time, rms, speed = samples.T
    figure, (by_time, by_speed) = _figure(7, 2.6, 2)
    for ax, x, label in ((by_time, time, 'time (s)'), (by_speed, 1e3 * speed, 'speed (mm/s)')):
        ax.plot(x, 1e3 * rms, '.', color=BLUE, ms=4)
        ax.set(xlabel=label, ylabel='RMS residual (mm)', ylim=(0, None))
    return svg(figure)


def histogram(stops: Sequence[StopSnapshot], stated: float) -> str:
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
    return svg(figure)


def coverage(stops: Sequence[StopSnapshot]) -> str:
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
    return svg(figure)


def profile(stop: StopSnapshot) -> str:
    """Return the plot of a profile of a stop with its features."""
    points = 1e3 * stop.points[np.isfinite(stop.points).all(axis=1)]
    points = points[::max(1, len(points) // MOST_POINTS)]
    figure, ax = _figure(3.2, 2.3, margins=PROFILE_MARGINS)
    ax.plot(*points.T, '.', color=GREY if stop.used else RED, ms=1.5)
    for feature in stop.features:
        _draw(ax, feature)
    ax.set(xlabel='along the line (mm)', ylabel='range (mm)')
    ax.invert_yaxis()
    return svg(figure)


def _draw(ax: Any, feature: Feature) -> None:
    if isinstance(feature, FaceLine):
        half_length = math.sqrt(3) * feature.spread * feature.direction  # of evenly spread points
        ends = 1e3 * np.array([feature.centre - half_length, feature.centre + half_length])
        ax.plot(*ends.T, color=BLUE, lw=1.6)
    elif isinstance(feature, EdgePoint):
        ax.plot(*(1e3 * feature.point), 'o', mfc='none', color=ORANGE, ms=7, mew=1.6)
    elif isinstance(feature, Arc):
        ax.plot(*(1e3 * feature.points).T, color=BLUE, lw=1.6)
