"""
Whether a calibration still holds: a short recording of the target it was made with.

The target is fitted with the calibration held, relative to where it was. What is left tells of
the sensor, how far the target moved tells of the target (or of the robot's base). Where the rest
is too large and a moved sensor explains it, the sensor moved; where it does not, the robot
measures otherwise than it did.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
import math
from typing import Any

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array, Calibration, Sample
from handeye_ros.errors import mm
from handeye_ros.estimation.quantiles import chi2_sf
from handeye_ros.results.outcome import mounted, sensor_axes
from handeye_ros.verification import wedge_place
from handeye_ros.verification.errors import NoCheckError, TooFewSeenError
from handeye_ros.verification.fixed_fit import fit, FixedFit, points_in_base
from handeye_ros.verification.routine import Seen, Shape
from handeye_ros.verification.routines import arcs, edge, faces
from handeye_ros.verification.shapes import Kinds
import numpy as np

FORMAT = 'handeye_ros/check/1'
SUSPICIOUS = 0.01  # p of what is no chance
LEAST_STATIONS = 4
ITERATIONS = 5


@dataclass(frozen=True)
class Check:
    """
    What a recording says of a calibration.

    verdict: unchanged, target (it, or the robot's base, moved), sensor, or robot (something that
    neither explains). p: of the distances, p_target: of the target's place, p_sensor: of the
    distances with a moved sensor. target_moved: (m), and target_turned (rad) where the target has
    directions. sensor_moved (m), sensor_turned (rad): by the distances; rms: of these (m).
    """

    stamp: int
    verdict: str
    sentence: str
    stations: int
    rms: float
    p: float
    p_target: float
    p_sensor: float
    target_moved: float
    target_turned: float
    sensor_moved: float
    sensor_turned: float


@dataclass(frozen=True)
class Target:
    """How a target is seen, and its shape (place in the base, as the calibration tells it)."""

    observe: Callable[[Sequence[Sample], Array, Array, Mapping[str, Any]], Any]
    shape: Callable[[Array, Mapping[str, Any]], tuple[Shape, int]]


def plane(p: Array, normal: Array, height: float) -> tuple[Shape, int]:
    """Return a plane: height and two tilts against where it was."""
    side = np.linalg.svd(normal[None])[2][1:]
    middle = p.mean(axis=0)

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        return np.asarray(p @ normal - height - q[0] - (p - middle) @ side.T @ q[1:])

    return Shape(np.zeros(3), distance, lambda q: q, (0.0,) * 3), 1


def _plate(p: Array, target: Mapping[str, Any]) -> tuple[Shape, int]:
    pose = target['pose']
    T = se3.from_quaternion(np.array([pose['translation'][a] for a in 'xyz']),
                            np.array([pose['rotation'][a] for a in 'xyzw']))
    return plane(p, T[:3, 2], float(T[:3, 2] @ T[:3, 3]))


def _plane(p: Array, target: Mapping[str, Any]) -> tuple[Shape, int]:
    return plane(p, np.array(target['normal'], dtype=float), float(target['distance']))


def _line(p: Array, target: Mapping[str, Any]) -> tuple[Shape, int]:
    way = np.array(target['direction'], dtype=float)
    side = np.linalg.svd(way[None])[2][1:]
    origin = np.array([target['point'][a] for a in 'xyz'])
    middle = float((p.mean(axis=0) - origin) @ way)

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        offset = p - origin
        along = (offset @ way - middle)[:, None]
        away = offset @ side.T - q[:2] - along * q[2:]
        return np.asarray(np.where(kind == 0, away[:, 0], away[:, 1]))

    return Shape(np.zeros(4), distance, lambda q: q, (0.0,) * 4), 2


def _sphere(p: Array, target: Mapping[str, Any]) -> tuple[Shape, int]:
    centre, radius = np.array([target['centre'][a] for a in 'xyz']), float(target['radius'])

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        return np.asarray(np.linalg.norm(p - centre - q, axis=1) - radius)

    return Shape(np.zeros(3), distance, lambda q: q, (0.0,) * 3), 3


def _alone(observe: Callable[[Sequence[Sample], Array, Array], Any]
           ) -> Callable[[Sequence[Sample], Array, Array, Mapping[str, Any]], Any]:
    """Return how a target is observed that needs not be told where it was."""
    return lambda samples, poses, X, told: observe(samples, poses, X)


TARGETS = {'plate': Target(_alone(faces), _plate), 'plane': Target(_alone(faces), _plane),
           'line': Target(_alone(edge), _line), 'sphere': Target(_alone(arcs), _sphere),
           'wedge': Target(wedge_place.both_faces, wedge_place.faces)}
"""The targets that a calibration can be checked with, by its method."""


def check(samples: Sequence[Sample], calibration: Calibration, config: Config, reason: str = ''
          ) -> Check:
    """
    Return what the samples of a recording say of a calibration made with the same target.

    reason: why other stations gave no sample. Raises NoCheckError, TooFewSeenError.
    """
    target = TARGETS.get(calibration.method)
    if target is None:
        raise NoCheckError(calibration.method, list(TARGETS))
    if len(samples) < LEAST_STATIONS:
        raise TooFewSeenError(len(samples), LEAST_STATIONS, reason)
    poses = mounted(samples, config)
    X = calibration.T_flange_sensor @ sensor_axes(config)
    try:
        seen = Seen(poses, target.observe(samples, poses, X, calibration.target))
        shape, places = target.shape(points_in_base(seen, X), calibration.target)
    except (KeyError, TypeError, ValueError) as error:
        raise NoCheckError(calibration.method, list(TARGETS)) from error
    found = fit(seen, X, calibration.covariance, config.noise, shape)
    off, p_sensor = _moved_sensor(seen, X, calibration.covariance, config, shape)
    return _judged(replace(found, error=off, p_error=p_sensor), places, samples[0].stamp,
                   len(samples))


def _moved_sensor(seen: Seen, X: Array, C: Array, config: Config, shape: Shape
                  ) -> tuple[Array, float]:
    """Return the error (6,) of X that explains the distances best, and their p with it."""
    moved = X
    for _ in range(ITERATIONS):
        found = fit(seen, moved, C, config.noise, shape)
        moved = se3.perturb(moved, -found.error)
    return se3.difference(X, moved), found.p_error


def _judged(found: FixedFit, places: int, stamp: int, stations: int) -> Check:
    p_target = float(chi2_sf(found.region, found.freedom))
    moved = float(np.linalg.norm(found.values[:places]))
    turned = float(np.linalg.norm(found.values[places:]))
    shift, turn = (float(np.linalg.norm(part)) for part in np.split(found.error, 2))
    rms = float(np.sqrt((found.distances ** 2).mean()))
    if found.p >= SUSPICIOUS and p_target >= SUSPICIOUS:
        verdict, sentence = 'unchanged', 'the calibration holds, and the target is where it was'
    elif found.p >= SUSPICIOUS:
        verdict = 'target'
        sentence = (f'the calibration holds; the target, or the base of the robot, moved by '
                    f'{mm(moved)} and turned by {math.degrees(turned):.3f} degrees')
    elif found.p_error >= SUSPICIOUS:
        verdict = 'sensor'
        sentence = (f'the sensor moved on the flange: points are off by up to '
                    f'{mm(found.implied)}; calibrate again')
    else:
        verdict = 'robot'
        sentence = (f'distances of {mm(rms)} RMS that no moved sensor and no moved target '
                    "explain: the robot's own calibration changed, the target is no longer what "
                    'it was, or the noise is set too small')
    return Check(stamp, verdict, sentence, stations, rms, found.p, p_target, found.p_error, moved,
                 turned, shift, turn)


def values(checks: Sequence[tuple[str, Check]], against: str) -> dict[str, Any]:
    """Return checks, each with the name of its recording, as plain values."""
    return {'format': FORMAT, 'against': against,
            'checks': [{'input': name, **asdict(found)} for name, found in checks]}
