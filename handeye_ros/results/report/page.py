"""
One HTML file that shows an answer to a person: verdict, scene, residuals, profiles, use.

It holds all that it shows: it opens without a network.
"""
from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, UTC
import json
from pathlib import Path
from typing import Any

from handeye_ros import __version__
from handeye_ros import config as configuration
from handeye_ros.config import Config
from handeye_ros.data import Calibration
from handeye_ros.output import write_whole
from handeye_ros.results import table
from handeye_ros.results.exports import REPORT, ros
from handeye_ros.results.exports.format import matrix
from handeye_ros.results.report import figures
from handeye_ros.results.report.evidence import (
    config_of,
    Evidence,
    in_plane,
    stated_noise,
    StopSnapshot,
    verdict,
)
from handeye_ros.results.report.scene import in_sensor, legend, scene
from handeye_ros.results.verified import COLUMNS, Verified
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
import numpy as np

NAME = REPORT


def write(calibration: Calibration, evidence: Evidence, path: Path,
          verified: Sequence[Verified] = ()) -> Path:
    """Write the report of a calibration; return its absolute path. Raises UnwritableError."""
    path = path.expanduser().absolute()
    write_whole(path, html(calibration, evidence, verified))
    return path


def html(calibration: Calibration, evidence: Evidence, verified: Sequence[Verified] = ()) -> str:
    """Return the text of the report; verified: what it was verified with."""
    config = config_of(calibration)
    return templates().get_template('report.html').render(
        _values(calibration, evidence, config) | {'verified': verified, 'columns': COLUMNS})


def templates() -> Environment:
    """Return what finds and fills the pages in assets/."""
    pages = Environment(loader=PackageLoader('handeye_ros.results.report', 'assets'),
                        autoescape=True, undefined=StrictUndefined, trim_blocks=True,
                        lstrip_blocks=True)
    pages.globals['source'] = lambda name: Markup(pages.get_template(name).render())
    return pages


def _values(calibration: Calibration, evidence: Evidence, config: Config) -> dict[str, Any]:
    used = [stop for stop in evidence.stops if stop.used and stop.features]
    seen = in_sensor(in_plane(tuple(f for stop in used for f in stop.features)), config)
    drawn = scene(calibration, evidence.stops, config)
    with figures.style():
        plots = {name: _image(svg) for name, svg in _plots(calibration, evidence, config)}
        profiles = [_profile(stop) for stop in evidence.stops]
    return {
        'c': calibration, 'verdict': verdict(calibration, evidence, seen),
        'version': __version__, 'now': datetime.now(UTC).isoformat(timespec='seconds'),
        'transform': list(table.transform_rows(calibration)),
        'facts': list(table.facts(calibration)), 'weakest': table.weakest(calibration.quality),
        'details': list(table.details(calibration.target)), 'matrix': matrix(calibration),
        'scene': Markup(json.dumps(drawn).replace('<', '\\u003c')), 'drawn': drawn,
        'legend': legend(drawn['parts']), 'plots': plots, 'profiles': profiles,
        'refused': [report for report in calibration.samples if not report.used],
        'settings': configuration.flatten(config).items(),
        'inputs': [_words(item) for item in calibration.provenance.get('inputs', ())],
        'uses': [('URDF or xacro', ros.joint(calibration)),
                 ('ROS 2, shell', ros.command(calibration))],
    }


def _plots(calibration: Calibration, evidence: Evidence, config: Config
           ) -> Iterator[tuple[str, str]]:
    """Yield the plots that there is data for, by name."""
    used = [stop for stop in evidence.stops if stop.used and stop.features]
    if not used:
        return
    yield 'coverage', figures.coverage(used)
    solved = [stop for stop in used if len(stop.residuals)]
    if solved:
        yield 'residuals', figures.residuals(solved)
        if len(evidence.sweep):
            yield 'sweep', figures.sweep(evidence.sweep)
        points = np.concatenate([in_plane(stop.features) for stop in solved])
        middle = in_sensor(points.mean(axis=0)[None], config)[0]
        arm = calibration.T_flange_sensor @ np.append(middle, 1.0)
        yield 'histogram', figures.histogram(
            solved, stated_noise(config.noise, float(np.linalg.norm(arm[:3]))))


def _profile(stop: StopSnapshot) -> dict[str, Any]:
    rms = float(np.sqrt((stop.residuals ** 2).mean())) if len(stop.residuals) else None
    return {'number': stop.number, 'used': stop.used, 'reason': stop.reason,
            'residual': None if rms is None else f'{rms * 1e3:.3f} mm',
            'image': _image(figures.profile(stop)) if len(stop.points) else ''}


def _image(svg: str) -> str:
    """Return an image for src=, apart from the page: what is inside cannot clash with it."""
    return 'data:image/svg+xml;base64,' + base64.b64encode(svg.encode()).decode()


def _words(values: Mapping[str, Any]) -> str:
    return ', '.join(f'{key} {value}' for key, value in values.items())
