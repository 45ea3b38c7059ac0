"""What the page shows of a session: its state, the profile of now, each stop, and the scene."""
from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Arc, Array, Calibration, EdgePoint, FaceLine, Feature
from handeye_ros.diagnosis.review import Review
from handeye_ros.diagnosis.summaries import stop_snapshot
from handeye_ros.errors import InputError
from handeye_ros.estimation.solution import Solution
from handeye_ros.frames import in_mount
from handeye_ros.guidance.following import anchor_of
from handeye_ros.guidance.limits import extremes
from handeye_ros.guidance.moves import Move
from handeye_ros.guidance.rules import edge_kinds
from handeye_ros.results import table
from handeye_ros.results.target_shape import shape
from handeye_ros.ros.node.live import LiveSession
from handeye_ros.ros.node.streams import Current
from handeye_ros.sampling.state import State
from handeye_ros.sampling.stops import Outcome
import numpy as np

MOST_POINTS = 400  # of a profile: a tablet shows no more
DIGITS = 6  # of a metre in a picture


def contents(state: State, live: LiveSession) -> dict[str, Any]:
    """Return what the page shows, as plain values; rows: the lines of the table of the answer."""
    config, current = live.config, live.streams.latest.current(live.config)
    verification = live.verification
    return {**asdict(state), 'profile': _profile(current), 'scene': scene(live, current),
            'accuracy': config.guidance.accuracy, 'edges': _edges(live),
            'rows': list(answer_rows(live.answer.calibration)),
            'verification': {'running': verification.text, 'verdict': verification.last,
                             'routine': config.verify.routine}}


def answer_rows(calibration: Calibration | None) -> Iterator[tuple[str, str, str, str]]:
    """Yield name, value, 1 sigma and unit of what a calibration says, as the table of a solve."""
    if calibration is None:
        return
    quality = calibration.quality
    yield from table.transform_rows(calibration)
    yield 'residual', f'{quality.residual_rms * 1e3:.3f}', '', 'mm'
    yield 'left out', f'{quality.holdout_rms * 1e3:.3f}', '', 'mm'
    yield 'samples used', str(quality.samples_used), '', ''


def stop_profile(live: LiveSession, number: int) -> dict[str, Any]:
    """Return a profile of a stop and what was found in it; raises InputError for no such stop."""
    for outcome in live.copied().outcomes:
        if outcome.number == number:
            seen = stop_snapshot(outcome, live.config)
            return _drawn(seen.points, seen.features, seen.reason)
    raise InputError(f'there is no stop {number}')


def _profile(current: Current | None) -> dict[str, Any] | None:
    """Return points and features of the profile of now."""
    return None if current is None else _drawn(current.points, current.features, current.reason)


def _drawn(points: Array, features: Iterable[Feature], reason: str) -> dict[str, Any]:
    """Return points, lines and spots, (x, range) each."""
    points = points[np.isfinite(points).all(axis=1)]
    every = -(-len(points) // MOST_POINTS) or 1
    lines, spots = [], []
    for f in features:
        if isinstance(f, FaceLine):
            reach = 3 ** 0.5 * f.spread * f.direction
            lines.append(rounded(np.array([f.centre - reach, f.centre + reach])))
        elif isinstance(f, EdgePoint):
            spots.append(rounded(f.point))
        elif isinstance(f, Arc):
            lines.append(rounded(f.points))
    return {'points': rounded(points[::every]), 'lines': lines, 'spots': spots, 'reason': reason}


def _edges(live: LiveSession) -> dict[int, str]:
    """Return the edges of the target that each sample of the fit crosses, by its number."""
    review = live.reviewer.review
    return {} if review is None else dict(_crossed(review, live.reviewer.reviewed))


def _crossed(review: Review, reviewed: Sequence[Outcome]) -> Iterator[tuple[int, str]]:
    problem = review.solution.problem
    names, kinds = problem.method.kinds, edge_kinds(problem.method)
    used = [outcome for outcome, agreement in zip(reviewed, review.agreements, strict=False)
            if agreement and agreement.used]
    for station, outcome in enumerate(used):
        seen = set(problem.observations.kind[problem.observations.station == station])
        yield outcome.number, ', '.join(names[kind] for kind in kinds if kind in seen)


def scene(live: LiveSession, current: Current | None) -> dict[str, Any]:
    """
    Return poses (rows of T (3, 4)) in what the target rests in, and what is drawn with them.

    known: whether they are those of the sensor, which is roughly known, or else of the flange;
    view: the field of view in the sensor plane; aim: the way to the next pose; move: what to do
    before the sensor is known.
    """
    config, review, advice = live.config, live.reviewer.review, live.reviewer.advice
    solution = review.solution if review and advice.sigmas else None
    X = np.eye(4) if solution is None else solution.estimate.X
    samples = [(o.number, o.sample.T_base_flange) for o in live.copied().outcomes if o.sample]
    pose = live.streams.latest.pose
    aim = advice.next.T_base_flange if advice.next else None
    seen = live.reviewer.seen
    if current:
        seen = extremes(np.concatenate([seen, current.points]))
    away = seen - seen.mean(axis=0) if len(seen) else seen
    around = seen[np.argsort(np.arctan2(away[:, 1], away[:, 0]))]

    def drawn(T_base_flange: Array | None) -> Any:
        return None if T_base_flange is None else rounded(
            (in_mount(T_base_flange, config) @ X)[:3])

    return {
        'known': solution is not None, 'range_sign': config.profile.range_sign,
        'round': config.target.type == 'sphere',
        'view': rounded(around), 'live': drawn(pose),
        'stations': [{'number': number, 'T': drawn(T)} for number, T in samples],
        'next': drawn(aim), 'aim': None if pose is None or aim is None else _way(pose, aim),
        'move': advice.move and _move(advice.move),
        **(_target(solution, config) if solution else {'edges': [], 'outline': []})}


def _way(T_base_flange: Array, aim: Array) -> dict[str, Any]:
    """Return what is left to do: metres along the axes of the base, rad about the flange's."""
    turn = se3.log_rotation(T_base_flange[:3, :3].T @ aim[:3, :3])
    shift = aim[:3, 3] - T_base_flange[:3, 3]
    return {'shift': rounded(shift), 'turn': rounded(turn),
            'distance': float(np.linalg.norm(shift)), 'angle': float(np.linalg.norm(turn))}


def _move(move: Move) -> dict[str, Any]:
    """Return a move from the first pose; R: (3, 3) of the sensor in that pose."""
    R = se3.exp_rotation(np.array([0.0, 0.0, move.turn])) @ se3.exp_rotation(
        np.append(move.tilt, 0.0))
    return {'turn': move.turn, 'tilt': rounded(move.tilt), 'place': rounded(move.place),
            'beside': move.beside, 'edge': move.edge, 'R': rounded(R)}


def _target(solution: Solution, config: Config) -> Mapping[str, Any]:
    problem, estimate = solution.problem, solution.estimate
    near = np.array([_spot(solution, i) for i in range(len(problem.poses))])
    found = shape(problem.method.measures.describe(estimate.target, solution.target_std),
                  config.target.size, near)
    ball = found.ball and (rounded(found.ball[0]), found.ball[1])
    return {'edges': [rounded(line) for line in found.edges], 'ball': ball,
            'outline': [rounded(line) for line in found.outline], 'spots': rounded(near)}


def _spot(solution: Solution, station: int) -> Array:
    """Return the point (3,) that stands for what a station saw."""
    x, z = anchor_of(solution.problem, station)
    return np.asarray((solution.problem.poses[station] @ solution.estimate.X
                       @ [x, 0.0, z, 1.0])[:3])


def rounded(values: Array | Sequence[float]) -> Any:
    """Return plain values that a picture can show."""
    return np.round(values, DIGITS).tolist()


def plain(value: Any) -> Any:
    """Return plain values without infinities and NaN, which JSON does not know."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if abs(value) < float('inf') else None
    return value
