"""Content of the page: state, current profile, profiles of stops, and the scene."""
from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from handeye_ros import se3
from handeye_ros.checks.review import Review, stop_snapshot
from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, Calibration, EdgePoint, FaceLine, Feature
from handeye_ros.errors import InputError
from handeye_ros.frames import in_mount
from handeye_ros.guidance.moves import Move
from handeye_ros.guidance.score import extremes
from handeye_ros.guidance.views import anchor_of
from handeye_ros.node.live import LiveSession
from handeye_ros.node.state import State
from handeye_ros.node.streams import Current
from handeye_ros.results import table
from handeye_ros.results.scene import shape
import numpy as np

MOST_POINTS = 400  # of a profile: about the pixels of a tablet
DIGITS = 6  # after the decimal point of a metre


def contents(state: State, live: LiveSession) -> dict[str, Any]:
    """Return the content of the page as plain values; rows: of the table of the answer."""
    config, current = live.config, live.streams.latest.current(live.config)
    verification = live.verification
    profile = current and _profile(current.points, current.features, current.reason)
    return {**asdict(state), 'profile': profile, 'scene': scene(live, current),
            'accuracy': config.guidance.accuracy, 'edges': _edges(live),
            'rows': list(answer_rows(live.answer.calibration)),
            'verification': {'running': verification.text, 'verdict': verification.last,
                             'routine': config.verify.routine}}


def answer_rows(calibration: Calibration | None) -> Iterator[tuple[str, str, str, str]]:
    """Yield name, value, 1 sigma and unit as in the table of `handeye solve`."""
    if calibration is None:
        return
    quality = calibration.quality
    yield from table.transform_rows(calibration)
    yield 'residual', f'{quality.residual_rms * 1e3:.3f}', '', 'mm'
    yield 'left out', f'{quality.holdout_rms * 1e3:.3f}', '', 'mm'
    yield 'samples used', str(quality.samples_used), '', ''


def stop_profile(live: LiveSession, number: int) -> dict[str, Any]:
    """Return a profile of a stop with its features; raises InputError for unknown stops."""
    for outcome in live.copied().outcomes:
        if outcome.number == number:
            snapshot = stop_snapshot(outcome, live.config)
            return _profile(snapshot.points, snapshot.features, snapshot.reason)
    raise InputError(f'there is no stop {number}')


def _profile(points: Array, features: Iterable[Feature], reason: str) -> dict[str, Any]:
    """Return points, lines and edge points in the sensor plane, (x, range) each."""
    points = points[np.isfinite(points).all(axis=1)]
    step = -(-len(points) // MOST_POINTS) or 1
    lines, spots = [], []
    for f in features:
        if isinstance(f, FaceLine):
            reach = 3 ** 0.5 * f.spread * f.direction
            lines.append(rounded(np.array([f.centre - reach, f.centre + reach])))
        elif isinstance(f, EdgePoint):
            spots.append(rounded(f.point))
        elif isinstance(f, Arc):
            lines.append(rounded(f.points))
    return {'points': rounded(points[::step]), 'lines': lines, 'spots': spots, 'reason': reason}


def _edges(live: LiveSession) -> dict[int, str]:
    """Return the edges of the target crossed by each used sample, by its number."""
    review = live.reviewer.review
    if review is None:
        return {}
    problem, edges = review.solution.problem, {}
    names, kinds = problem.method.kinds, problem.method.essential_kinds
    used = [outcome for outcome, agreement in zip(live.reviewer.reviewed, review.agreements,
                                                  strict=False) if agreement and agreement.used]
    for station, outcome in enumerate(used):
        crossed = set(problem.observations.kind[problem.observations.station == station])
        edges[outcome.number] = ', '.join(names[kind] for kind in kinds if kind in crossed)
    return edges


def scene(live: LiveSession, current: Current | None) -> dict[str, Any]:
    """
    Return poses (rows of T (3, 4)) in the frame of the fixed target, and the target.

    known: whether the poses are of the sensor, or of the flange while the sensor's is unknown;
    view: outline of the field of view in the sensor plane; aim: the motion to the next pose; move:
    the advice while the sensor's pose is unknown.
    """
    config, review, advice = live.config, live.reviewer.review, live.reviewer.advice
    review = review if advice.sigmas else None
    X = review.solution.estimate.X if review else np.eye(4)
    samples = [(o.number, o.sample.T_base_flange) for o in live.copied().outcomes if o.sample]
    pose = live.streams.latest.pose
    aim = advice.next.T_base_flange if advice.next else None
    extreme_points = live.reviewer.extremes
    if current:
        extreme_points = extremes(np.concatenate([extreme_points, current.points]))
    offset = extreme_points - extreme_points.sum(axis=0) / max(len(extreme_points), 1)
    outline = extreme_points[np.argsort(np.arctan2(offset[:, 1], offset[:, 0]))]

    def drawn(T_base_flange: Array | None) -> Any:
        return None if T_base_flange is None else rounded(
            (in_mount(T_base_flange, config) @ X)[:3])

    return {
        'known': review is not None, 'range_sign': config.profile.range_sign,
        'round': config.target.type == 'sphere',
        'view': rounded(outline), 'live': drawn(pose),
        'stations': [{'number': number, 'T': drawn(T)} for number, T in samples],
        'next': drawn(aim), 'aim': None if pose is None or aim is None else _motion_to(pose, aim),
        'move': advice.move and _move(advice.move),
        **(_target(review, config) if review else {'edges': [], 'outline': []})}


def _motion_to(T_base_flange: Array, aim: Array) -> dict[str, Any]:
    """Return the motion to a pose: m along the axes of the base, rad about those of the flange."""
    turn = se3.log_rotation(T_base_flange[:3, :3].T @ aim[:3, :3])
    shift = aim[:3, 3] - T_base_flange[:3, 3]
    return {'shift': rounded(shift), 'turn': rounded(turn),
            'distance': float(np.linalg.norm(shift)), 'angle': float(np.linalg.norm(turn))}


def _move(move: Move) -> dict[str, Any]:
    """Return a move relative to the first pose; R: (3, 3) of the sensor after the move."""
    R = se3.exp_rotation(np.array([0.0, 0.0, move.turn])) @ se3.exp_rotation(
        np.append(move.tilt, 0.0))
    return {'turn': move.turn, 'tilt': rounded(move.tilt), 'place': rounded(move.place),
            'beside': move.beside, 'edge': move.edge, 'R': rounded(R)}


def _target(review: Review, config: Config) -> Mapping[str, Any]:
    """Return edges, outline and ball of the target, and a point (3,) for each station."""
    problem, estimate = review.solution.problem, review.solution.estimate
    anchors = np.array([anchor_of(problem, i) for i in range(len(problem.poses))])
    in_sensor = np.insert(anchors, 1, 0.0, axis=1)  # (x, range) as (x, 0, range)
    points = se3.apply(problem.poses @ estimate.X, in_sensor[:, None])[:, 0]
    form = shape(problem.method.measures.describe(estimate.target, review.solution.target_std),
                 config.target.size, points)
    ball = form.ball and (rounded(form.ball[0]), form.ball[1])
    return {'edges': [rounded(line) for line in form.edges], 'ball': ball,
            'outline': [rounded(line) for line in form.outline], 'spots': rounded(points)}


def rounded(values: Array | Sequence[float]) -> Any:
    """Return an array as lists with DIGITS decimals."""
    return np.round(values, DIGITS).tolist()


def plain(value: Any) -> Any:
    """Return plain values with None for infinities and NaN, which JSON lacks."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if abs(value) < float('inf') else None
    return value
