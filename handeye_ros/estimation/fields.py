"""
Smooth functions of few coefficients: of the sensor's plane, of a face, of the robot's poses.

What the unknowns of the problem absorb anyway (a motion of the sensor, a tilt of the face) is
taken out of them.
"""
from __future__ import annotations

from handeye_ros.data import Array
import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

ALIKE_POSITION = 0.6  # poses this far apart (m), or turned this far (rad), share half the error
ALIKE_ROTATION = 1.0
SAME_PLACE = 0.01  # of these lengths: nearer poses err alike
MOST_PLACES = 24  # that span the robot's error


def polynomials(u: Array, v: Array, degree: int) -> Array:
    """Return products (m, degree + 1) of Legendre polynomials of u and v (m,), each of RMS 1."""
    norm = np.sqrt(2 * np.arange(degree + 1) + 1)
    a, b = (legendre.legvander(_normalised(w), degree) * norm for w in (u, v))
    return np.column_stack([a[:, i] * b[:, degree - i] for i in range(degree + 1)])


def _normalised(w: Array) -> Array:
    low, high = w.min(), w.max()
    return np.asarray((2 * w - low - high) / max(high - low, 1e-9))


def without(columns: Array, absorbed: Array) -> Array:
    """Return columns (m, k) without what absorbed (m, j) explains of them."""
    length = np.linalg.norm(absorbed, axis=0)
    absorbed = absorbed[:, length > 0] / length[length > 0]
    inverse = np.linalg.pinv(absorbed.T @ absorbed, rcond=1e-10, hermitian=True)
    return np.asarray(columns - absorbed @ (inverse @ (absorbed.T @ columns)))


def bending(points: Array, degree: int) -> Array:
    """
    Return fields (m, 2, k) over points (m, 2) of the sensor plane, together of RMS 1 each way.

    degree: of the polynomials. No motion of the plane in itself is in them.
    """
    m = len(points)
    x, z = (points - points.mean(axis=0)).T
    one, none = np.ones(m), np.zeros(m)
    terms = polynomials(x, z, degree)
    zero = np.zeros_like(terms)
    fields = np.block([[terms, zero], [zero, terms]])
    rigid = np.block([[one[:, None], none[:, None], z[:, None]],
                      [none[:, None], one[:, None], -x[:, None]]])
    fields = without(fields, rigid) / terms.shape[1] ** 0.5
    return np.stack([fields[:m], fields[m:]], axis=1)


def bent_faces(p: Array, here: NDArray[np.bool_], degree: int) -> Array:
    """Return heights (m, k), together of RMS 1, over a face with the points p (m, 3) here (m,)."""
    points = p[here]
    if len(points) <= 3:
        return np.zeros((len(p), 0))
    centred = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    u, v = centred @ axes[:, 2], centred @ axes[:, 1]
    some = polynomials(u, v, degree)
    terms = np.zeros((len(p), some.shape[1]))
    flat = np.column_stack([np.ones(len(u)), u, v])
    terms[here] = without(some, flat) / some.shape[1] ** 0.5
    return terms


def places(poses: Array) -> Array:
    """Return where poses (n, 4, 4) are, (n, 6), in units over which the robot's error is alike."""
    rotations = Rotation.from_matrix(poses[:, :3, :3])
    vectors = (rotations.mean().inv() * rotations).as_rotvec()
    return np.concatenate([poses[:, :3, 3] / ALIKE_POSITION, vectors / ALIKE_ROTATION], axis=1)


def likeness(a: Array, b: Array) -> Array:
    """Return the correlations (n, k) of smooth errors at places (n, 6) and (k, 6)."""
    squared = ((a[:, None] - b[None]) ** 2).sum(axis=2)
    return np.asarray(1.0 / (1.0 + squared))


def process(place: Array) -> Array:
    """
    Return the root (n, k) of the covariance of a smooth process of unit variance at places.

    A rational quadratic kernel, that is of many scales of length at once; of very many places it
    is spanned by some (Nystroem).
    """
    some = place[spread(place, MOST_PLACES)]
    own = likeness(some, some)
    values, vectors = np.linalg.eigh(own)
    keep = values > 1e-6 * values[-1]
    return np.asarray(likeness(place, some) @ (vectors[:, keep] / np.sqrt(values[keep])))


def spread(place: Array, most: int) -> list[int]:
    """Return the indices of at most so many places (n, 6) that are far from each other."""
    chosen = [0]
    nearest = ((place - place[0]) ** 2).sum(axis=1)
    while len(chosen) < most and nearest.max() > SAME_PLACE ** 2:
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, ((place - place[chosen[-1]]) ** 2).sum(axis=1))
    return chosen
