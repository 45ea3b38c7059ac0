"""
A laser tracker beside the robot (Jing 2020), as one least-squares problem.

The tracker follows a reflector on the last link of a P1 R2 P3 arm: an arc while R2 turns, a line
while P3 moves. It also measures the centre of a ball and points on two faces of a block, and so
does the profiler while P3 carries it over both. The paper chains separate fits: link frame,
temporary frame K of ball and face normals, sensor. Here that chain is the start, and all points
are adjusted together: the ball and the faces are the same for both instruments, and the sweep
runs along the line that the reflector drew.

Flange: frame 3 (D-H), z along P3, x along the common normal of R2 and P3.
"""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from handeye_ros.data import Array
from handeye_ros.errors import DataError
from handeye_ros.estimation.outliers import adjust, Adjusted
from handeye_ros.published import jing2020
from handeye_ros.tables import LENGTH, Table, TableError
from handeye_ros.tabulated import tracker_model
from handeye_ros.tabulated.tracker_model import Seen, State, Sweep
import numpy as np
from numpy.typing import NDArray

NAME = 'the chain through the laser tracker'
KINDS = ('arc', 'line', 'ball', 'face_c', 'face_d')
TOO_FEW = {'arc': 6, 'line': 3, 'ball': 1, 'face_c': 3, 'face_d': 3}
SMALLEST_ANGLE = 0.17  # smallest angle between the faces, and of the arc (rad)
ORDERED = 20  # points of arc and line whose order is checked
ONE_WAY = 0.75  # smallest share of steps in one direction; about half for unordered points
LARGEST_TURN = 0.35  # largest angle between the sweep (by the ball) and the line (rad)
LARGEST_STD = (5e-3, 1e-2)  # of an answer (m, rad)
LARGEST_VARIANCE = 9.0
LARGEST_DROPPED_SHARE = 0.34


@dataclass(frozen=True, eq=False)
class TrackerResult:
    """
    The result.

    T_flange_sensor, T_tracker_flange (at q30): (4, 4); covariance: (6, 6) of the first, x y z rx
    ry rz in the flange; skew: deviation of R2 and P3 from a right angle; face_angle: between the
    face normals (rad); radius: of the ball (m); distances: (n,) of all points, see
    tracker_model.distances; used: indices of the used ones; left_out: (used,) leave-one-out
    distances (m); holdout_rms: their RMS (sigmas); state: all unknowns.
    """

    T_flange_sensor: Array
    T_tracker_flange: Array
    covariance: Array
    skew: float
    face_angle: float
    radius: float
    variance_factor: float
    distances: Array
    used: NDArray[np.intp]
    left_out: Array
    holdout_rms: float
    state: State


def read(path: Path, h0: float, h1: float) -> jing2020.Tracker:
    """
    Return the reflector points of a file.

    Columns kind (arc, line, ball, face_c or face_d) and x, y, z with their unit, as in `x [mm]`,
    in the order measured. h0: reflector above P3's top, h1: its top above the origin of frame 2
    (metres). Raises TableError.
    """
    table = Table(path)
    kinds, points = np.array(table.text('kind')), table.values('xyz', LENGTH)
    for row, kind in enumerate(kinds, 1):
        if kind not in KINDS:
            raise TableError(path, f'row {row}: kind is "{kind}", expected {", ".join(KINDS)}')
    parts = {kind: points[kinds == kind] for kind in KINDS}
    for kind, fewest in TOO_FEW.items():
        if len(parts[kind]) < fewest:
            raise TableError(path, f'holds {len(parts[kind])} points of the kind {kind}; at least '
                             f'{fewest} are needed')
    parts['ball'] = parts['ball'].mean(axis=0)
    return jing2020.Tracker(**parts, h0=h0, h1=h1)


def solve(tracker: jing2020.Tracker, sweep: Sweep, tracker_noise: float = 2e-5,
          direction: Array = jing2020.SWEEP) -> TrackerResult:
    """
    Return the hand-eye transform.

    tracker_noise: 1 sigma per axis of a reflector centre (m); direction: (3,) of the sweep in
    the sensor frame, roughly. Raises TooFewError, DataError.
    """
    _require_order(tracker)
    chain = jing2020.solve(tracker, sweep.published, direction)
    _require_angles(tracker, chain.angles)
    _require_one_direction(chain)
    seen = Seen(tracker, sweep, tracker_noise)
    fit = adjust(tracker_model.system(seen), tracker_model.start(chain, seen),
                 tracker_model.MINIMUM)
    _require_agreement(fit, seen)
    _require_certain(fit.covariance[6:12, 6:12])
    return _result(fit, seen)


def _result(fit: Adjusted[State], seen: Seen) -> TrackerResult:
    state = fit.state
    m = state.rest[8:].reshape(2, 3)
    cosine = m[0] @ m[1] / np.linalg.norm(m[0]) / np.linalg.norm(m[1])
    distances, sigma = tracker_model.distances(state, seen)
    return TrackerResult(
        state.X, state.T_tracker_2 @ tracker_model.link(seen.sweep.q30),
        fit.covariance[6:12, 6:12], float(state.rest[0]), float(np.arccos(cosine)),
        float(state.rest[7]), fit.variance_factor, distances, fit.used,
        fit.left_out[:, 0] * sigma[fit.used], float(np.sqrt((fit.left_out ** 2).mean())), state)


def _require_order(tracker: jing2020.Tracker) -> None:
    """Raise for an arc or a line whose points are not in measured order."""
    arc, line = (points[np.linspace(0, len(points) - 1, min(len(points), ORDERED)).astype(int)]
                 for points in (tracker.arc, tracker.line))
    centre, axis = jing2020.fit_arc(tracker.arc)
    turns = np.cross(arc[:-1] - centre, arc[1:] - centre) @ axis
    for what, steps in (('arc', turns), ('line', np.diff(line @ jing2020.fit_line(line)))):
        if max((steps > 0).mean(), (steps < 0).mean()) < ONE_WAY:
            raise DataError(
                f'{NAME} cannot be solved: the points of the {what} go back and forth; list them '
                'in the order measured')


def _require_angles(tracker: jing2020.Tracker, faces: Array) -> None:
    """Raise for an arc that is too short, and for faces that are nearly parallel."""
    centre, axis = jing2020.fit_arc(tracker.arc)
    first, last = tracker.arc[0] - centre, tracker.arc[-1] - centre
    turn = np.arctan2(np.linalg.norm(np.cross(first, last)), first @ last)
    if turn < SMALLEST_ANGLE:
        raise DataError(
            f'{NAME} cannot be solved: the arc spans {np.degrees(turn):.1f} degrees; turn R2 by '
            '30 degrees or more')
    if min(*faces, *(np.pi - faces)) < SMALLEST_ANGLE:
        raise DataError(
            f'{NAME} cannot be solved: the two faces of the block are nearly parallel; use faces '
            'at 45 degrees or more')


def _require_one_direction(chain: jing2020.Result) -> None:
    """Raise for a sweep whose direction by the ball differs from that of the link."""
    cosine = float(chain.direction @ chain.T_flange_sensor[2, :3])
    if cosine < np.cos(LARGEST_TURN):
        raise DataError(
            f'{NAME} cannot be solved: the sweep runs '
            f'{np.degrees(np.arccos(max(cosine, -1.0))):.0f} degrees beside the line of the '
            'reflector; check which face is which, tracker.direction, and that the line was '
            'measured towards larger readings of P3')


def _require_agreement(fit: Adjusted[State], seen: Seen) -> None:
    part = tracker_model.parts(seen)
    dropped = 1 - np.bincount(part[fit.used], minlength=part.max() + 1) / np.bincount(part)
    worst = int(np.argmax(dropped))
    if fit.variance_factor > LARGEST_VARIANCE or dropped[worst] > LARGEST_DROPPED_SHARE:
        raise DataError(
            f'{NAME} cannot be solved: the points contradict each other: '
            f'{fit.variance_factor ** 0.5:.1f} times their noise, {100 * dropped[worst]:.0f} % '
            f'of those of {list(tracker_model.PARTS.values())[worst]} left out; check which face '
            'is which, h0 and h1, the readings of P3, and the noise of both instruments')


def _require_certain(covariance: Array) -> None:
    worst = [float(np.sqrt(np.linalg.eigvalsh(part)[-1]))
             for part in (covariance[:3, :3], covariance[3:, 3:])]
    if worst[0] > LARGEST_STD[0] or worst[1] > LARGEST_STD[1]:
        raise DataError(
            f'{NAME} cannot be solved: the answer is uncertain by {worst[0] * 1e3:.3g} mm and '
            f'{np.degrees(worst[1]):.3g} degrees (1 sigma); check which face is which; measure a '
            'longer arc and line, sweep over more of ball and faces')
