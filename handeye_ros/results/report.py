# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The report of a calibration: verdict, scene, residuals, profiles and use of an answer.

The file is complete: it opens without a network.
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from handeye_ros import config as configuration
from handeye_ros import se3
from handeye_ros.data import Array, Calibration
from handeye_ros.output import figure, image, page, style
from handeye_ros.results import exports, table, verification_file
from handeye_ros.results.calibration_file import config_of
from handeye_ros.results.evidence import Evidence, in_plane, StopSnapshot, verdict
from handeye_ros.results.scene import in_sensor, profile_picture, scene
import numpy as np

BLUE, ORANGE = '#1f6fb4', '#e07b00'


def html(calibration: Calibration, evidence: Evidence,
         verified: Sequence[Mapping[str, Any]] = ()) -> str:
    """Return the text of the report; verified: contents of verifications to include."""
    config = config_of(calibration)
    used = [stop for stop in evidence.stops if stop.used and stop.features]
    points = in_sensor(in_plane(f for stop in used for f in stop.features), config)
    drawn = scene(calibration, evidence.stops, config)
    with style():
        plots = dict(_plots(used, evidence.sweep))
    return page(
        'report.html', c=calibration, verdict=verdict(calibration, evidence, points),
        transform=list(table.transform_rows(calibration)),
        facts=list(table.facts(calibration)), weakest=table.weakest(calibration.quality),
        details=list(table.details(calibration.target)), matrix=exports.matrix(calibration),
        scene=drawn, legend={part['name']: part['color'] for part in drawn['parts']}.items(),
        plots=plots, stops=[(stop, _rms_text(stop)) for stop in evidence.stops],
        profiles=[profile_picture(stop.points, stop.features) for stop in evidence.stops],
        refused=[report for report in calibration.samples if not report.used],
        settings=configuration.flatten(config).items(), verified=verified,
        columns=verification_file.COLUMNS, title_of=verification_file.title_of,
        look_of=verification_file.look_of, rows_of=verification_file.rows_of,
        inputs=[', '.join(f'{key} {value}' for key, value in item.items())
                for item in calibration.provenance.get('inputs', ())],
        uses=[('URDF or xacro', exports.joint(calibration)),
              ('ROS 2, shell', exports.command(calibration))])


def _rms_text(stop: StopSnapshot) -> str:
    return f'{1e3 * _rms(stop.residuals):.3f} mm' if len(stop.residuals) else 'used'


def _rms(values: Array) -> float:
    return float(np.sqrt((values ** 2).mean()))


def _plots(used: Sequence[StopSnapshot], sweep: Array) -> Iterator[tuple[str, str]]:
    """Yield the plots with data, by name; used: stops; sweep: as in Evidence."""
    if used:
        yield 'coverage', _coverage_plot(used)
    solved = [stop for stop in used if len(stop.residuals)]
    if solved:
        yield 'residuals', _residuals_plot(solved)
        if len(sweep):
            yield 'sweep', _sweep_plot(sweep)


def _residuals_plot(stops: Sequence[StopSnapshot]) -> str:
    """Return the plot of RMS residuals of stops, in the fit and left out."""
    drawing, ax = figure(1, 1, 7, 2.6)
    positions = np.arange(len(stops))
    for shift, color, label, values in (
            (-0.2, BLUE, 'in the fit', [stop.residuals for stop in stops]),
            (0.2, ORANGE, 'left out of the fit', [stop.left_out for stop in stops])):
        ax.bar(positions + shift, [1e3 * _rms(v) for v in values], 0.4, color=color, label=label)
    ax.set_xticks(positions, [str(stop.number) for stop in stops], fontsize=7)
    ax.set(xlabel='stop', ylabel='RMS residual (mm)')
    ax.legend(loc='upper right', ncols=2)
    return image(drawing)


def _sweep_plot(samples: Array) -> str:
    """Return the plot of a sweep's residuals over time and speed; samples: as in Evidence."""
    time, rms, speed = samples.T
    drawing, (by_time, by_speed) = figure(1, 2, 3.5, 2.6)
    for ax, x, label in ((by_time, time, 'time (s)'), (by_speed, 1e3 * speed, 'speed (mm/s)')):
        ax.plot(x, 1e3 * rms, '.', color=BLUE, ms=4)
        ax.set(xlabel=label, ylabel='RMS residual (mm)', ylim=(0, None))
    return image(drawing)


def _coverage_plot(stops: Sequence[StopSnapshot]) -> str:
    """Return the plot of positions in the field of view, and of rotations of the sensor."""
    points = 1e3 * in_plane(f for stop in stops for f in stop.features)
    T = np.array([stop.T_mount for stop in stops])
    turns = np.degrees(se3.log_rotation(T[:, :3, :3] @ se3.mean_pose(T)[:3, :3].T))
    drawing, (field_axes, rotation_axes) = figure(1, 2, 3.5, 3.1)
    field_axes.plot(*points.T, '.', color=BLUE, ms=4)
    field_axes.set(xlabel='along the laser line (mm)', ylabel='range (mm)',
                   title='Field of view that was used')
    field_axes.invert_yaxis()
    dots = rotation_axes.scatter(turns[:, 0], turns[:, 1], c=turns[:, 2], s=22, cmap='viridis')
    rotation_axes.set(xlabel='turn about x (degrees)', ylabel='turn about y (degrees)',
                      aspect='equal', adjustable='datalim', title='Rotations from their mean')
    drawing.colorbar(dots, ax=rotation_axes, label='turn about z (degrees)')
    return image(drawing)
