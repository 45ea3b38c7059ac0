"""
Unknowns and residuals of arm, tracker, ball and block.

Flange: frame 3 (D-H), z along P3, x along the common normal of R2 and P3.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import Rows, System
from handeye_ros.published import jing2020
import numpy as np
from numpy.typing import NDArray

QUARTER_TURN = se3.exp_rotation(np.array([np.pi / 2, 0.0, 0.0]))
STEP = 1e-7  # of the numeric derivatives (m, rad, 1)
PARTS = {'arc': 'the arc', 'line': 'the line', 'centre': "the ball's centre",
         'spots_c': 'face_c', 'spots_d': 'face_d', 'ball': 'the swept ball',
         'face_c': 'the swept face at smaller x', 'face_d': 'the swept face at larger x'}
SWEPT = ('ball', 'face_c', 'face_d')
UNKNOWNS = 26
OF_X = slice(6, 12)
MINIMUM = 27  # residuals


@dataclass(frozen=True, eq=False)
class Sweep:
    """
    Points of the profiles of the sweep, (n, 4) each: x, z in the sensor plane, q3, 1 sigma (m).

    face_c is the face at smaller x. q30: reading of P3 at which the flange frame is taken. stamps:
    of each point's profile, by the name of the part; empty if unknown.
    """

    ball: Array
    face_c: Array
    face_d: Array
    q30: float
    stamps: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)

    @property
    def published(self) -> jing2020.Sweep:
        """Return the points in the form of the published algorithm, without sigmas."""
        return jing2020.Sweep(self.ball[:, :3], self.face_c[:, :3], self.face_d[:, :3], self.q30)


@dataclass(frozen=True, eq=False)
class Seen:
    """The measurements of both instruments; noise: of the tracker, 1 sigma per axis (m)."""

    tracker: jing2020.Tracker
    sweep: Sweep
    noise: float


@dataclass(frozen=True, eq=False)
class State:
    """
    The unknowns.

    T_tracker_2, X: (4, 4), frame 2 of the arm and T_flange_sensor; rest: (14,) deviation of R2 and
    P3 from a right angle, arc radius, x and z of the line in frame 2, ball centre and radius, and
    m of both faces (m . p = 1), in the sensor frame at q30.
    """

    T_tracker_2: Array
    X: Array
    rest: Array


def link(q3: float) -> Array:
    """Return frame 3 at reading q3 in frame 2 (4, 4): eq. 7."""
    return se3.transform(QUARTER_TURN, QUARTER_TURN[:, 2] * q3)


def start(chain: jing2020.Result, seen: Seen) -> State:
    """Return the state of the published chain."""
    sweep = seen.sweep
    T_tracker_2 = chain.T_tracker_flange @ se3.inverse(link(sweep.q30))
    to_2 = se3.inverse(T_tracker_2)
    arc, line = se3.apply(to_2, seen.tracker.arc), se3.apply(to_2, seen.tracker.line)
    _, ball, radius = jing2020.fit_swept_ball(sweep.ball[:, :3], sweep.q30, chain.direction)
    faces = []
    for points in (sweep.face_c, sweep.face_d):
        cloud = jing2020.swept(points[:, :3], sweep.q30, chain.direction)
        normal = jing2020.fit_plane(cloud)
        faces.append(normal / (normal @ cloud.mean(axis=0)))
    rest = np.concatenate([[0.0, np.linalg.norm(arc[:, :2], axis=1).mean()],
                           line[:, [0, 2]].mean(axis=0), ball, [radius], *faces])
    return State(T_tracker_2, chain.T_flange_sensor, rest)


def system(seen: Seen, given_X: bool = False) -> System[State]:
    """
    Return the least-squares system: all 26 unknowns, or 20 with X given.

    Each distance is a block.
    """
    basis = np.eye(UNKNOWNS)
    basis = np.delete(basis, OF_X, axis=0) if given_X else basis

    def retract(state: State, step: Array) -> State:
        step = step @ basis
        return State(se3.perturb(state.T_tracker_2, step[:6]), se3.perturb(state.X, step[OF_X]),
                     state.rest + step[12:])

    def white(state: State) -> Array:
        r, sigma = distances(state, seen)
        return r / sigma

    def rows(state: State) -> Rows:
        r = white(state)

        def jacobian() -> Array:
            return np.stack([(white(retract(state, step)) - r) / STEP
                             for step in STEP * np.eye(len(basis))], axis=1)
        return Rows(r, jacobian)
    return System(rows, retract, np.arange(len(parts(seen))))


def distances(state: State, seen: Seen) -> tuple[Array, Array]:
    """Return the residual distance (n,) of each point from the model, and its 1 sigma (n,); m."""
    by_tracker = _of_tracker(state, seen)
    parts = [_of_sensor(state, seen.sweep, part) for part in SWEPT]
    r, sigma = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return (np.concatenate([by_tracker, r]),
            np.concatenate([np.full(len(by_tracker), seen.noise), sigma]))


def sources(of: Mapping[str, NDArray[np.intp]]) -> NDArray[np.intp]:
    """Return, for each distance (n,), the value that `of` holds for its point, by part."""
    return np.concatenate([of['arc'], of['arc'], np.repeat(of['line'], 2),
                           np.repeat(of['centre'], 3), of['spots_c'], of['spots_d'],
                           *(of[part] for part in SWEPT)])


def parts(seen: Seen) -> NDArray[np.intp]:
    """Return, for each distance (n,), the part of its point as an index into PARTS."""
    tracker, sweep = seen.tracker, seen.sweep
    points = (tracker.arc, tracker.line, tracker.ball[None], tracker.face_c, tracker.face_d,
              sweep.ball, sweep.face_c, sweep.face_d)
    return sources({part: np.full(len(of), i) for i, (part, of) in enumerate(
        zip(PARTS, points, strict=True))})


def _of_tracker(state: State, seen: Seen) -> Array:
    tracker, faces = seen.tracker, state.rest[8:].reshape(2, 3)
    to_2 = se3.inverse(state.T_tracker_2)
    axis = np.array([0.0, np.sin(state.rest[0]), np.cos(state.rest[0])])
    arc = se3.apply(to_2, tracker.arc) - (tracker.h0 + tracker.h1) * axis
    height = arc @ axis
    spoke = np.linalg.norm(arc - height[:, None] * axis, axis=1) - state.rest[1]
    line = se3.apply(to_2, tracker.line)[:, [0, 2]] - state.rest[2:4]
    T_tracker_sensor = state.T_tracker_2 @ link(seen.sweep.q30) @ state.X
    centre = se3.apply(T_tracker_sensor, state.rest[None, 4:7])[0] - tracker.ball
    spots = [_height(se3.apply(se3.inverse(T_tracker_sensor), points), face)
             for points, face in zip((tracker.face_c, tracker.face_d), faces, strict=True)]
    return np.concatenate([height, spoke, line.ravel(), centre, *spots])


def _of_sensor(state: State, sweep: Sweep, part: str) -> tuple[Array, Array]:
    """Return distances (n,) of a swept part and 1 sigma (n,), for errors in the sensor plane."""
    points: Array = getattr(sweep, part)
    cloud = jing2020.swept(points[:, :3], sweep.q30, state.X[2, :3])
    if part == 'ball':
        from_centre = cloud - state.rest[4:7]
        distance = np.linalg.norm(from_centre, axis=1)
        r, normals = distance - state.rest[7], from_centre / distance[:, None]
    else:
        face = state.rest[8:].reshape(2, 3)[SWEPT.index(part) - 1]
        r, normals = _height(cloud, face), face / np.linalg.norm(face)
    return r, points[:, 3] * np.hypot(normals[..., 0], normals[..., 2])


def _height(points: Array, face: Array) -> Array:
    """Return the heights (n,) of points (n, 3) over a face m . p = 1."""
    return np.asarray((points @ face - 1) / np.linalg.norm(face))
