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
from typing import Any

from handeye_ros import se3
from handeye_ros.adjust import adjust, Adjusted, Model
from handeye_ros.data import Array
from handeye_ros.errors import DegenerateError, TableError
from handeye_ros.published import jing2020
from handeye_ros.tables import LENGTH, Table
import numpy as np
from numpy.typing import NDArray

NAME = 'the chain through the laser tracker'
KINDS = ('arc', 'line', 'ball', 'face_c', 'face_d')
TOO_FEW = {'arc': 6, 'line': 3, 'ball': 1, 'face_c': 3, 'face_d': 3}
QUARTER_TURN = se3.exp_rotation(np.array([np.pi / 2, 0.0, 0.0]))
STEP = 1e-7  # of the numeric derivatives (m, rad, 1)
SMALLEST_ANGLE = 0.17  # between the faces, and of the arc (rad)
LARGEST_STD = (5e-3, 1e-2)  # of an answer (m, rad)
LARGEST_VARIANCE = 9.0
LARGEST_DROPPED_SHARE = 0.34


@dataclass(frozen=True, eq=False)
class Sweep:
    """
    Points of the profiles of the sweep, (n, 4) each: x, z in the sensor plane, q3, 1 sigma (m).

    face_c is the face at smaller x. q30: the reading of P3 at which the flange is taken.
    """

    ball: Array
    face_c: Array
    face_d: Array
    q30: float

    @property
    def published(self) -> jing2020.Sweep:
        """Return the same as the published algorithm takes it, which knows no sigma."""
        return jing2020.Sweep(self.ball[:, :3], self.face_c[:, :3], self.face_d[:, :3], self.q30)


@dataclass(frozen=True, eq=False)
class State:
    """
    The unknowns.

    T_tracker_2, X: (4, 4), the link's frame 2 and T_flange_sensor; rest: (14,) angle by which R2
    and P3 are not square, radius of the arc, x and z of the line in frame 2, centre and radius of
    the ball and both faces m . p = 1 in the sensor at q30.
    """

    T_tracker_2: Array
    X: Array
    rest: Array


@dataclass(frozen=True, eq=False)
class TrackerResult:
    """
    The answer.

    T_flange_sensor, T_tracker_flange at q30: (4, 4); covariance: (6, 6) of the first, x y z rx
    ry rz in the flange; skew: by which R2 and P3 are not square, face_angle: between the
    normals (rad); radius: of the ball; used: indices among all residuals; variance_factor;
    holdout_rms: of the used residuals, each against the answer without it (sigmas).
    """

    T_flange_sensor: Array
    T_tracker_flange: Array
    covariance: Array
    skew: float
    face_angle: float
    radius: float
    used: NDArray[np.intp]
    variance_factor: float
    holdout_rms: float


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
    the sensor frame, roughly. Raises TooFewError, DegenerateError.
    """
    chain = jing2020.solve(tracker, sweep.published, direction)
    _require_angles(tracker, chain.angles)
    model = Model(lambda state: _blocks(state, tracker, sweep, tracker_noise), _retract, 27)
    fit = adjust(model, _start(chain, tracker, sweep))
    _require_agreement(fit)
    _require_certain(fit.covariance[6:12, 6:12])
    state = fit.state
    m = state.rest[8:].reshape(2, 3)
    cosine = m[0] @ m[1] / np.linalg.norm(m[0]) / np.linalg.norm(m[1])
    return TrackerResult(state.X, state.T_tracker_2 @ _link(sweep.q30),
                         fit.covariance[6:12, 6:12], float(state.rest[0]),
                         float(np.arccos(cosine)), float(state.rest[7]), fit.used,
                         fit.variance_factor, float(np.sqrt((fit.left_out ** 2).mean())))


def _link(q3: float) -> Array:
    """Return frame 3 at reading q3 in frame 2 (4, 4): eq. 7."""
    return se3.transform(QUARTER_TURN, QUARTER_TURN[:, 2] * q3)


def _start(chain: jing2020.Result, tracker: jing2020.Tracker, sweep: Sweep) -> State:
    """Return the state that the published chain is."""
    T_tracker_2 = chain.T_tracker_flange @ se3.inverse(_link(sweep.q30))
    to_2 = se3.inverse(T_tracker_2)
    arc, line = se3.apply(to_2, tracker.arc), se3.apply(to_2, tracker.line)
    _, ball, radius = jing2020.fit_swept_ball(sweep.ball[:, :3], sweep.q30, chain.direction)
    faces = []
    for points in (sweep.face_c, sweep.face_d):
        cloud = jing2020.swept(points[:, :3], sweep.q30, chain.direction)
        normal = jing2020.fit_plane(cloud)
        faces.append(normal / (normal @ cloud.mean(axis=0)))
    rest = np.concatenate([[0.0, np.linalg.norm(arc[:, :2], axis=1).mean()],
                           line[:, [0, 2]].mean(axis=0), ball, [radius], *faces])
    return State(T_tracker_2, chain.T_flange_sensor, rest)


def _retract(state: State, step: Array) -> State:
    return State(se3.perturb(state.T_tracker_2, step[:6]), se3.perturb(state.X, step[6:12]),
                 state.rest + step[12:])


def _blocks(state: State, *measured: Any) -> tuple[Array, Array]:
    """Return the whitened residuals (n, 1) and their derivatives (n, 1, 26)."""
    r = _residuals(state, *measured)
    columns = [(_residuals(_retract(state, step), *measured) - r) / STEP
               for step in STEP * np.eye(12 + len(state.rest))]
    return r[:, None], np.stack(columns, axis=1)[:, None]


def _residuals(state: State, tracker: jing2020.Tracker, sweep: Sweep, noise: float) -> Array:
    skew, ball, radius = state.rest[0], state.rest[4:7], state.rest[7]
    faces = state.rest[8:].reshape(2, 3)
    to_2 = se3.inverse(state.T_tracker_2)
    axis = np.array([0.0, np.sin(skew), np.cos(skew)])
    arc = se3.apply(to_2, tracker.arc) - (tracker.h0 + tracker.h1) * axis
    height = arc @ axis
    spoke = np.linalg.norm(arc - height[:, None] * axis, axis=1) - state.rest[1]
    line = se3.apply(to_2, tracker.line)[:, [0, 2]] - state.rest[2:4]
    T_tracker_sensor = state.T_tracker_2 @ _link(sweep.q30) @ state.X
    seen = se3.apply(T_tracker_sensor, ball[None])[0] - tracker.ball
    spots = [_height(se3.apply(se3.inverse(T_tracker_sensor), points), face)
             for points, face in zip((tracker.face_c, tracker.face_d), faces, strict=True)]
    by_tracker = np.concatenate([height, spoke, line.ravel(), seen, *spots]) / noise
    from_ball = _swept(sweep.ball, sweep.q30, state.X) - ball
    distance = np.linalg.norm(from_ball, axis=1)
    by_sensor = [_white(distance - radius, from_ball / distance[:, None], sweep.ball)]
    for points, face in zip((sweep.face_c, sweep.face_d), faces, strict=True):
        cloud = _swept(points, sweep.q30, state.X)
        by_sensor.append(_white(_height(cloud, face), face / np.linalg.norm(face), points))
    return np.concatenate([by_tracker, *by_sensor])


def _swept(points: Array, q30: float, X: Array) -> Array:
    """Return the points of profiles (n, 3) in the sensor at q30, carried along the flange's z."""
    return jing2020.swept(points[:, :3], q30, X[2, :3])


def _height(points: Array, face: Array) -> Array:
    """Return the heights (n,) of points (n, 3) over a face m . p = 1."""
    return np.asarray((points @ face - 1) / np.linalg.norm(face))


def _white(r: Array, normals: Array, points: Array) -> Array:
    """Return distances (n,) along normals over their sigma: points err in the sensor plane."""
    return np.asarray(r / (points[:, 3] * np.hypot(normals[..., 0], normals[..., 2])))


def _require_angles(tracker: jing2020.Tracker, faces: Array) -> None:
    """Refuse an arc that is hardly one, and faces that are nearly parallel."""
    centre, axis = jing2020.fit_arc(tracker.arc)
    first, last = tracker.arc[0] - centre, tracker.arc[-1] - centre
    turn = np.arctan2(np.linalg.norm(np.cross(first, last)), first @ last)
    if turn < SMALLEST_ANGLE:
        raise DegenerateError(NAME, f'the arc spans {np.degrees(turn):.1f} degrees',
                              'turn R2 by 30 degrees or more')
    if min(*faces, *(np.pi - faces)) < SMALLEST_ANGLE:
        raise DegenerateError(NAME, 'the two faces of the block are nearly parallel',
                              'use faces at 45 degrees or more')


def _require_agreement(fit: Adjusted[State]) -> None:
    dropped = 1 - len(fit.used) / len(fit.residuals)
    if fit.variance_factor > LARGEST_VARIANCE or dropped > LARGEST_DROPPED_SHARE:
        raise DegenerateError(
            NAME, f'the points contradict each other: {fit.variance_factor ** 0.5:.1f} times '
            f'their noise, {100 * dropped:.0f} % left out', 'check which face is which, h0 and '
            'h1, the readings of P3, and the noise of both instruments')


def _require_certain(covariance: Array) -> None:
    worst = [float(np.sqrt(np.linalg.eigvalsh(part)[-1]))
             for part in (covariance[:3, :3], covariance[3:, 3:])]
    if worst[0] > LARGEST_STD[0] or worst[1] > LARGEST_STD[1]:
        raise DegenerateError(
            NAME, f'the answer is known only to {worst[0] * 1e3:.3g} mm and '
            f'{np.degrees(worst[1]):.3g} degrees (1 sigma)', 'check which face is which; '
            'measure a longer arc and line, sweep over more of ball and faces')
