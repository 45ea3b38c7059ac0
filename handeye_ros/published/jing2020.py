# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Jing, Hu, Guo 2020: multiple coordinates transformation with a laser tracker.

Journal of Shanghai Jiao Tong University 54(6), doi 10.16183/j.cnki.jsjtu.2019.033. A reflector on
the last link of a P1 R2 P3 arm draws an arc (R2) and a line (P3): the link's frame in the
tracker. A reflector's ball and two faces of a block make a temporary frame K that the tracker
measures and the profiler too, swept over it by P3. X = inv(T_tracker_flange) T_tracker_sensor.

Section 2 and eqs. 3 and 4 are its baseline, the fixed point from different poses: a ball of known
radius R stands still; each profile cuts it in a circle (x_c, z_c, r_c), so its centre in the
sensor is (x_c, y_c, z_c) with y_c = +-sqrt(R^2 - r_c^2), and all of these are one point of the
base. As A x = b that is linear in the twelve elements of the hand-eye matrix.

What is wrong in print, and what is done here:

- the column of Table 1 headed r_c holds negative numbers, so it must be z; y stands beside it
  with its sign, which comes from knowing on which side of the ball the laser was: `sides`.
- how A x = b is formed is not said; the common centre is eliminated by taking the mean off. Its x
  is no rotation; `fixed_point_linear` returns the nearest one.
- the printed p_y = 0 of all three trials is no measurement: an arm with one axis of rotation
  leaves t along it free, and the solution of least norm puts 0 there.
- eqs. 6, 8 and 11 use measured directions as the columns of a frame. They are not square, so
  they are orthonormalised; as both K are treated alike, a block that is not square does no harm.
- eq. 9 shifts the profile along the sensor's own z by q3 - q30. P3 moves along z of frame 3,
  which with the paper's X (90 degrees about x) is y of the sensor, and only nearly so. The
  direction is estimated: only the right one makes the ball a ball.
- the signs of the directions are not said: the arc is taken in the sense of growing theta2, the
  line in that of growing q3, and each face's normal points away from the other face's points.
- Table 2 cannot be recomputed: the faces are 63.9 degrees apart in one frame, 66.7 in the other.

The heights follow eq. 6; h3(q3) of eq. 7 is D-H (Craig) with alpha = 90 degrees, a = 0.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.arithmetic import fit_round
from handeye_ros.data import Array
from handeye_ros.errors import require_count
import numpy as np

MIN_CENTRES = 4
"""Of the ball in the linear solution: three equations each, less three for the centre."""

LENGTH_UNIT = 0.1
"""Metres per unit of length in A x = b: what the rank is judged by."""

SWEEP: Array = np.array([0.0, 1.0, 0.0])
"""The sweep's direction in the sensor frame to start from: P3 along y."""


@dataclass(frozen=True, eq=False)
class Readings:
    """
    What tracker and profiler see, metres.

    parts: points (n, 3) by part. Reflector centres in the tracker's frame: arc, while R2 turns;
        line, while P3 moves, R2 as in the sweep; ball, only one; face_c, face_d, on the two faces.
        Profile points of the sweep, x, z in the sensor plane and q3: swept_ball, swept_face_c,
        swept_face_d.
    height: of the reflector above the origin of frame 2 (h0 + h1)
    q30: the reading at which the sensor frame is taken
    """

    parts: Mapping[str, Array]
    height: float
    q30: float


@dataclass(frozen=True, eq=False)
class Result:
    """
    The chain of eq. 5, and what shows whether to believe it.

    direction: (3,) of the sweep in the sensor frame, per metre of q3
    radius: of the ball as swept
    face_angle: between the faces as the tracker saw them (radians)
    """

    T_flange_sensor: Array
    direction: Array
    radius: float
    face_angle: float


def solve(measured: Readings, direction: Array = SWEEP) -> Result:
    """
    Return the hand-eye transform by eqs. 5 to 12.

    direction: (3,) of the sweep in the sensor frame, roughly: it settles the sign of y, which
    the ball leaves open. Raises TooFewError.
    """
    parts, q30 = measured.parts, measured.q30
    direction, ball, radius = fit_swept_ball(parts['swept_ball'], q30, direction)
    by_tracker = parts['face_c'], parts['face_d']
    by_sweep = [swept(parts[f'swept_{face}'], q30, direction) for face in ('face_c', 'face_d')]
    T_tracker_sensor = (block_frame(parts['ball'][0], *by_tracker)
                        @ se3.inverse(block_frame(ball, *by_sweep)))
    return Result(se3.inverse(link_frame(measured)) @ T_tracker_sensor, direction, radius,
                  face_angle(*by_tracker))


def link_frame(measured: Readings) -> Array:
    """Return T_tracker_flange (4, 4), frame 3 at reading q30, by eqs. 6 and 7."""
    centre, axis = fit_arc(measured.parts['arc'])
    along = fit_line(measured.parts['line'])
    R = se3.nearest_rotation(np.column_stack([-np.cross(along, axis), -along, axis]))
    T_tracker_2 = se3.transform(R, centre - R[:, 2] * measured.height)
    turned = se3.exp_rotation(np.array([np.pi / 2, 0.0, 0.0]))
    return np.asarray(T_tracker_2 @ se3.transform(turned, turned[:, 2] * measured.q30))


def block_frame(ball: Array, face_c: Array, face_d: Array) -> Array:
    """Return the temporary frame K (4, 4) of eqs. 8 and 11 in the frame of the points."""
    n_c, n_d = face_normals(face_c, face_d)
    R = se3.nearest_rotation(np.column_stack([n_c, n_d, np.cross(n_c, n_d)]))
    return se3.transform(R, ball)


def face_angle(face_c: Array, face_d: Array) -> float:
    """Return the angle (radians) between the normals of two faces, (n, 3) and (m, 3) points."""
    n_c, n_d = face_normals(face_c, face_d)
    return float(np.arccos(np.clip(n_c @ n_d, -1.0, 1.0)))


def face_normals(face_c: Array, face_d: Array) -> tuple[Array, Array]:
    """Return the outward normals (3,) of two neighbouring faces of a convex block."""
    from_c_to_d = face_d.mean(axis=0) - face_c.mean(axis=0)
    n_c, n_d = fit_plane(face_c), fit_plane(face_d)
    return -n_c * np.sign(n_c @ from_c_to_d), n_d * np.sign(n_d @ from_c_to_d)


def fit_plane(points: Array) -> Array:
    """Return a unit normal (3,) of the plane of points (n, 3). Raises TooFewError."""
    require_count('Jing 2020', 3, 'points on each face', len(points))
    return np.asarray(np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2])


def fit_line(points: Array) -> Array:
    """Return the unit direction (3,) of points (n, 3), first to last. Raises TooFewError."""
    require_count('Jing 2020', 2, 'reflector points on the line', len(points))
    along = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
    return np.asarray(along * np.sign(along @ (points[-1] - points[0])))


def fit_arc(points: Array) -> tuple[Array, Array]:
    """
    Return centre (3,) and unit axis (3,) of the arc through points (n, 3).

    The axis is that of the turn from each point to the next. Raises TooFewError.
    """
    require_count('Jing 2020', 3, 'reflector points on the arc', len(points))
    mean = points.mean(axis=0)
    basis = np.linalg.svd(points - mean)[2]
    flat = (points - mean) @ basis[:2].T
    from scipy.optimize import least_squares  # 0.1 s, only for trackers
    fit = least_squares(lambda c: np.linalg.norm(flat - c[:2], axis=1) - c[2], fit_round(flat),
                        xtol=1e-15, ftol=1e-15, gtol=1e-15, method='lm')
    spokes = flat - fit.x[:2]
    turn = np.sum(spokes[:-1, 0] * spokes[1:, 1] - spokes[:-1, 1] * spokes[1:, 0])
    return mean + fit.x[:2] @ basis[:2], np.sign(turn) * np.cross(basis[0], basis[1])


def swept(points: Array, q30: float, direction: Array) -> Array:
    """Return (n, 3) in the sensor frame at q30 of profile points (n, 3) x, z, q3 (eqs. 9, 10)."""
    cloud = np.insert(points[:, :2], 1, 0.0, axis=1)
    return np.asarray(cloud + (points[:, 2:] - q30) * direction)


def fit_swept_ball(points: Array, q30: float, direction: Array) -> tuple[Array, Array, float]:
    """
    Return the sweep's direction (3,) and the ball's centre (3,) and radius, sensor frame.

    points: (n, 3) x, z, q3 on the ball; direction: (3,) roughly. Raises TooFewError.
    """
    require_count('Jing 2020', 6, 'profile points on the ball', len(points))
    aside = np.linalg.svd(direction[None])[2][1:]

    def at(unknown: Array) -> Array:
        turned = direction + unknown[:2] @ aside
        return se3.unit(turned)

    def residuals(unknown: Array) -> Array:
        cloud = swept(points, q30, at(unknown))
        return np.asarray(np.linalg.norm(cloud - unknown[2:5], axis=1) - unknown[5])

    start = np.append(np.zeros(2), fit_round(swept(points, q30, direction)))
    from scipy.optimize import least_squares  # 0.1 s, only for trackers
    fit = least_squares(residuals, start, x_scale='jac', method='lm', xtol=1e-15, ftol=1e-15,
                        gtol=1e-15)
    return at(fit.x), fit.x[2:5], float(fit.x[5])


def ball_centres(circles: Array, radii: Array, radius: float, sides: Array) -> Array:
    """
    Return the centres (n, 3) of the ball in the sensor frame (metres).

    circles: (n, 2) centres x, z; radii: (n,); radius: the ball's; sides: (n,) sign of the
    centre's y. A circle that noise made larger than the ball counts as a cut through its centre.
    """
    y = sides * np.sqrt(np.maximum(radius ** 2 - radii ** 2, 0.0))
    return np.column_stack([circles[:, 0], y, circles[:, 1]])


def fixed_point_linear(T_base_flange: Array, centres: Array) -> tuple[Array, Array]:
    """
    Return T_flange_sensor (4, 4) and the ball's centre (3,) in the base: eqs. 3 and 4.

    T_base_flange: (n, 4, 4); centres: (n, 3) from `ball_centres`. The solution of least norm, with
    the nearest rotation. Raises TooFewError.
    """
    require_count('the fixed point', MIN_CENTRES, 'measurements', len(centres))
    R, a = T_base_flange[:, :3, :3], T_base_flange[:, :3, 3] / LENGTH_UNIT
    A = np.concatenate([R * c for c in (*centres.T[:, :, None, None] / LENGTH_UNIT, 1.0)], axis=2)
    mean_A, mean_a = A.mean(axis=0), a.mean(axis=0)
    x = np.linalg.lstsq((A - mean_A).reshape(-1, 12), (mean_a - a).ravel(), rcond=1e-10)[0]
    R = se3.nearest_rotation(x[:9].reshape(3, 3).T)
    return se3.transform(R, x[9:] * LENGTH_UNIT), (mean_A @ x + mean_a) * LENGTH_UNIT


def fixed_point_least_squares(T_base_flange: Array, centres: Array) -> Array:
    """
    Return the T_flange_sensor (4, 4) that brings the centres together best.

    Arguments and errors as `fixed_point_linear`, whose answer is the start. Gauss-Newton with
    steps of least norm: what the data leave free stays as it was at the start.
    """
    T, ball = fixed_point_linear(T_base_flange, centres)
    base = T_base_flange[:, :3, :3]
    for _ in range(100):
        residuals = se3.apply(T_base_flange @ T, centres[:, None])[:, 0] - ball
        arms = se3.skew(centres @ T[:3, :3].T)
        J = np.concatenate([base * LENGTH_UNIT, -base @ arms,
                            np.broadcast_to(-np.eye(3) * LENGTH_UNIT, base.shape)], axis=2)
        step = np.linalg.lstsq(J.reshape(-1, 9), -residuals.ravel(), rcond=1e-6)[0]
        T = se3.perturb(T, np.append(step[:3] * LENGTH_UNIT, step[3:6]))
        ball = ball + step[6:] * LENGTH_UNIT
        if np.linalg.norm(step) < 1e-12:
            break
    return T
