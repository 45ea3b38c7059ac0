"""The two faces of a wedge where a calibration saw them, to be looked for there again."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Array, Sample
from handeye_ros.estimation.linearise import points_at
from handeye_ros.estimation.model import Observations
from handeye_ros.targets import wedge
from handeye_ros.verification.routine import Shape
from handeye_ros.verification.shapes import Kinds
import numpy as np

CONFIG = Config()  # of which the conditions of a wedge ask nothing


def state_of(told: Mapping[str, Any]) -> Array:
    """Return the target of targets/wedge.py as a calibration tells it; raises KeyError."""
    x = np.array(told['direction'], dtype=float)
    first, second = (np.array(told[key], dtype=float) for key in ('normal_1', 'normal_2'))
    y = first - (first @ x) * x
    y /= np.linalg.norm(y)
    R = np.column_stack([x, y, np.cross(x, y)])
    turns = [np.arctan2(n @ R[:, 2], n @ R[:, 1]) for n in (first, second)]
    T = se3.transform(R, np.array([told['point'][a] for a in 'xyz']))
    return np.append(T.ravel(), turns)


def both_faces(samples: Sequence[Sample], poses: Array, X: Array, told: Mapping[str, Any]
               ) -> Observations:
    """Return two points of each face line, given to the face that it fits better."""
    found = wedge.observe(samples)
    return wedge.relabel(found, points_at(found, poses, X), state_of(told), CONFIG)


def faces(p: Array, told: Mapping[str, Any]) -> tuple[Shape, int]:
    """
    Return the faces: the edge's two places and tilts, the turn about it and the faces' angle.

    All but the angle are measured against where they were.
    """
    state = state_of(told)
    T = state[:16].reshape(4, 4).copy()
    T[:3, 3] += T[:3, 0] * float((p.mean(axis=0) - T[:3, 3]) @ T[:3, 0])
    state = np.append(T.ravel(), state[16:])

    def distance(p: Array, kind: Kinds, q: Array) -> Array:
        return wedge.conditions(p, kind, wedge.retract(state, q), CONFIG).g

    return Shape(np.zeros(6), distance, lambda q: q, (*(0.0,) * 5, None)), 2
