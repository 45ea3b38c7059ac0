"""What the page shows of a session: its state, the profile of now, and a small scene."""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, Calibration, EdgePoint, FaceLine
from handeye_ros.estimation.solution import Solution
from handeye_ros.guidance.candidates import anchor_of
from handeye_ros.results import table
from handeye_ros.results.outcome import in_mount
from handeye_ros.results.target_shape import shape
from handeye_ros.ros.node.live import LiveSession
from handeye_ros.ros.node.streams import Current
from handeye_ros.sampling.state import State
import numpy as np

MOST_POINTS = 400  # of a profile: a tablet shows no more
DIGITS = 6  # of a metre in a picture


def contents(state: State, live: LiveSession) -> dict[str, Any]:
    """Return what the page shows, as plain values; rows: the lines of the table of the answer."""
    return {**asdict(state), 'profile': _profile(live.latest.current(live.config)),
            'scene': _scene(live), 'accuracy': live.config.guidance.accuracy,
            'rows': list(answer_rows(live.answer.calibration))}


def answer_rows(calibration: Calibration | None) -> Iterator[tuple[str, str, str, str]]:
    """Yield name, value, 1 sigma and unit of what a calibration says, as the table of a solve."""
    if calibration is None:
        return
    quality = calibration.quality
    yield from table.transform_rows(calibration)
    yield 'residual', f'{quality.residual_rms * 1e3:.3f}', '', 'mm'
    yield 'left out', f'{quality.holdout_rms * 1e3:.3f}', '', 'mm'
    yield 'samples used', str(quality.samples_used), '', ''


def _profile(current: Current | None) -> dict[str, Any] | None:
    """Return points and features of a profile, (x, range) each."""
    if current is None:
        return None
    points = current.points[np.isfinite(current.points).all(axis=1)]
    every = -(-len(points) // MOST_POINTS) or 1
    lines, spots = [], []
    for f in current.features:
        if isinstance(f, FaceLine):
            reach = 3 ** 0.5 * f.spread * f.direction
            lines.append(rounded(np.array([f.centre - reach, f.centre + reach])))
        elif isinstance(f, EdgePoint):
            spots.append(rounded(f.point))
        elif isinstance(f, Arc):
            lines.append(rounded(f.points))
    return {'points': rounded(points[::every]), 'lines': lines, 'spots': spots,
            'reason': current.reason}


def _scene(live: LiveSession) -> dict[str, Any]:
    """Return stations, target and next pose, in what the target rests in."""
    config, review = live.config, live.review
    solution = review.solution if review else None
    X = solution.estimate.X if solution else None
    samples = [(o.number, o.sample.T_base_flange) for o in live.copied().outcomes if o.sample]
    pose = live.advice.next
    return {
        'stations': [{'number': number, **_station(T, X, config)} for number, T in samples],
        'next': _station(pose.T_base_flange, X, config) if pose else None,
        **(_target(solution, config) if solution else {'edges': [], 'outline': []})}


def _station(T_base_flange: Array, X: Array | None, config: Config) -> dict[str, Any]:
    """Return where the flange and, once roughly known, the sensor is, and which way it looks."""
    T = in_mount(T_base_flange, config)
    sensor = None if X is None else T @ X
    return {'flange': rounded(T[:3, 3]),
            'sensor': None if sensor is None else rounded(sensor[:3, 3]),
            'looks': None if sensor is None else rounded(
                sensor[:3, 2] * config.profile.range_sign)}


def _target(solution: Solution, config: Config) -> Mapping[str, Any]:
    problem, estimate = solution.problem, solution.estimate
    near = np.array([_spot(solution, i) for i in range(len(problem.poses))])
    found = shape(problem.method.measures.describe(estimate.target, solution.target_std),
                  config.target.size, near)
    return {'edges': [rounded(line) for line in found.edges],
            'outline': [rounded(line) for line in found.outline], 'spots': rounded(near)}


def _spot(solution: Solution, station: int) -> Array:
    """Return the point (3,) that stands for what a station saw."""
    x, z = anchor_of(solution.problem, station)
    return np.asarray((solution.problem.poses[station] @ solution.estimate.X
                       @ [x, 0.0, z, 1.0])[:3])


def rounded(values: Array | Sequence[float]) -> Any:
    """Return plain values that a picture can show."""
    return np.round(values, DIGITS).tolist()
