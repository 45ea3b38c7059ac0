# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Chen, Zhou, Zhang, Ren 2023: hand-eye calibration under orthogonal constraints.

Laser & Infrared 53(5), doi 10.3969/j.issn.1001-5078.2023.05.015. Any two points of edge p of a
plate span a vector, any two of edge q another, and all these vectors are perpendicular.

What is wrong in print, and what is done here:

- eq. 7 sums the products v_p . v_q without squaring them. Over ordered pairs that sum is zero
  for every x, so it is no objective; the squares are summed here.
- N points give N (N - 1) / 2 vectors, not N!; the sum over them needs none. With S = sum
  (x - mean)(x - mean)', the sum of v v' over unordered pairs is N S, so the sum of squares over n
  and m points is n m trace(S_p S_q). Over ordered pairs, as eq. 7 runs, it is four times that.
- eq. 4 leaves out r1 . r3 = 0, and the matrix printed in Table 2 is no rotation; the nearest one
  is returned, and `solve_rigid` solves with all constraints.
- the start of the interior-point method is not said; see `STARTS`.
- Table 1 cannot be recomputed (columns swapped, one orientation per edge).

The objective sees no lines, only two perpendicular spans: five points per edge at the least.
"""
from __future__ import annotations

from typing import cast

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import require_count
import numpy as np
from scipy.optimize import Bounds, least_squares, minimize, NonlinearConstraint
from scipy.spatial.transform import Rotation

MIN_POINTS = 5
"""Fewest points per edge: six unknowns and two free spans."""

LENGTH_UNIT = 0.2
"""Metres per unit of t inside the solvers: a lever arm comparable to the sensor's range."""

_GROUP = Rotation.create_group('O').as_matrix()
STARTS: Array = np.stack([_GROUP[np.argmax(_GROUP[:, :, 2] @ axis)]
                          for axis in np.vstack([np.eye(3), -np.eye(3)])])
"""(6, 3, 3) rotations to start from, with t = 0: the range along each half axis of the flange."""

_OPTIONS = {'gtol': 1e-9, 'xtol': 1e-12, 'barrier_tol': 1e-12, 'maxiter': 250,
            'initial_tr_radius': 0.3}  # a first step of 1 leaves the constraints for good


def edge_rows(T_base_flange: Array, points: Array) -> Array:
    """
    Return M (k, 3, 10) with the scatter of M @ [r1, r3, t / LENGTH_UNIT, 1] that of the edge.

    T_base_flange: (n, 4, 4); points: (n, 2), x and z (metres). M is eq. 3, centred; beyond 30
    points its triangular factor replaces it, so the solver's cost does not depend on n.
    """
    R = T_base_flange[:, :3, :3]
    columns = [R * points[:, :1, None], R * points[:, 1:, None], R * LENGTH_UNIT,
               T_base_flange[:, :3, 3:]]
    M = np.concatenate(columns, axis=2)
    M -= M.mean(axis=0)
    if len(M) <= 30:
        return M
    _, triangle = np.linalg.qr(M.reshape(-1, 30))
    return triangle.reshape(30, 3, 10)


def cost(rows: tuple[Array, Array], u: Array) -> tuple[float, Array, Array]:
    """
    Return trace(S_p S_q), its gradient (9,) and Hessian (9, 9) in u = [r1, r3, t / LENGTH_UNIT].

    rows: M of edge p and of edge q from `edge_rows`.
    """
    sides = []
    for M in rows:
        P = M @ np.append(u, 1.0)
        half = np.tensordot(M[:, :, :9], P, axes=(0, 0)).transpose(1, 0, 2)
        sides.append((P.T @ P, half + half.transpose(0, 2, 1)))
    (S_p, D_p), (S_q, D_q) = sides
    D_p, D_q = D_p.reshape(9, 9), D_q.reshape(9, 9)
    gradient = D_p @ S_q.ravel() + D_q @ S_p.ravel()
    H = D_p @ D_q.T
    H = H + H.T
    for M, S in ((rows[0], S_q), (rows[1], S_p)):
        H += 2.0 * M[:, :, :9].reshape(-1, 9).T @ (S @ M[:, :, :9]).reshape(-1, 9)
    return float(np.sum(S_p * S_q)), gradient, H


def solve_nine(T_base_flange: Array, points: Array, edges: Array) -> Array:
    """
    Return T_flange_sensor by eq. 7 (squared) over nine parameters: an interior-point method.

    T_base_flange: (n, 4, 4); points: (n, 2) edge points, x and z in the sensor plane (metres);
    edges: (n,) 'p' or 'q'. scipy's trust-constr with |r1| = |r3| = 1 (eq. 4); a box of 1.5 around
    every direction cosine and 1.5 m around t makes the barrier; the nearest rotation is returned.
    With five points per edge the seven unknowns are poorly held; the paper advises six and more.
    Raises TooFewError.
    """
    rows = _rows(T_base_flange, points, edges)
    bound = np.repeat([1.5, 1.5 / LENGTH_UNIT], [6, 3])
    solutions = []
    for R in STARTS:
        start = np.concatenate([R[:, 0], R[:, 2], np.zeros(3)])
        p, q = (M @ np.append(start, 1.0) for M in rows)
        scale = 1e3 / float(np.sum(p ** 2) * np.sum(q ** 2))  # for the solver's tolerances
        solutions.append(minimize(
            lambda u, s=scale: (s * cost(rows, u)[0], s * cost(rows, u)[1]), start, jac=True,
            hess=lambda u, s=scale: s * cost(rows, u)[2], method='trust-constr',
            bounds=Bounds(-bound, bound), constraints=[_norms()], options=_OPTIONS).x)
    return _best(rows, np.array(solutions))


def solve_rigid(T_base_flange: Array, points: Array, edges: Array) -> Array:
    """
    Return T_flange_sensor with the least of the same sum on SE(3).

    Arguments and errors as `solve_nine`. The products p_i . q_j of all centred points have
    trace(S_p S_q) as their sum of squares, so six unknowns and n m residuals say the same as
    all pairs of pairs.
    """
    rows = _rows(T_base_flange, points, edges)
    solutions = []
    for R in STARTS:
        fit = least_squares(_products, np.zeros(6), args=(rows, R), method='lm', xtol=1e-15,
                            ftol=1e-15, gtol=1e-15, max_nfev=4000)
        solutions.append(_parameters(fit.x, R))
    return _best(rows, np.array(solutions))


def _rows(T_base_flange: Array, points: Array, edges: Array) -> tuple[Array, Array]:
    """Return the rows of both edges."""
    masks = [np.asarray(edges) == edge for edge in 'pq']
    for edge, mask in zip('pq', masks, strict=True):
        require_count('Chen 2023', MIN_POINTS, f'points on edge {edge}', int(mask.sum()))
    p, q = (edge_rows(T_base_flange[mask], points[mask]) for mask in masks)
    return p, q


def _norms() -> NonlinearConstraint:
    """Return eq. 4."""
    B = np.zeros((2, 9, 9))
    B[0, :3, :3] = B[1, 3:6, 3:6] = 2.0 * np.eye(3)
    return NonlinearConstraint(
        lambda u: 0.5 * (B @ u) @ u, 1.0, 1.0, jac=lambda u: B @ u,
        hess=lambda _, weights: np.tensordot(weights, B, axes=1))


def _parameters(delta: Array, R: Array) -> Array:
    """Return the nine parameters of a step delta (rotation vector, t / LENGTH_UNIT) from R."""
    rotation = se3.exp_rotation(delta[:3]) @ R
    return np.concatenate([rotation[:, 0], rotation[:, 2], delta[3:]])


def _products(delta: Array, rows: tuple[Array, Array], R: Array) -> Array:
    """Return the products of all centred points of both edges, flat."""
    p, q = (M @ np.append(_parameters(delta, R), 1.0) for M in rows)
    return cast(Array, (p @ q.T).ravel())


def _best(rows: tuple[Array, Array], solutions: Array) -> Array:
    """Return the transform of the start that ended lowest, of those that met eq. 4."""
    costs = np.array([cost(rows, u)[0] for u in solutions])
    norms = np.linalg.norm(solutions[:, :6].reshape(-1, 2, 3), axis=2)
    met = np.abs(norms - 1.0).max(axis=1) < 1e-6
    best = solutions[np.argmin(np.where(met, costs, np.inf if met.any() else costs))]
    columns = np.column_stack([best[:3], np.cross(best[3:6], best[:3]), best[3:6]])
    return se3.transform(se3.nearest_rotation(columns), best[6:] * LENGTH_UNIT)
