"""
The next robot configurations: poses already sampled, in other postures of the arm.

A candidate brings the sensor to a pose that it had already, by another solution of the inverse
kinematics within the limits of the joints: there the target is surely in view. The candidates with
the most information on joints and hand-eye transform are chosen one after the other.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.robot.errors import NoPostureError
from handeye_ros.robot.estimate import Fit
from handeye_ros.robot.model import Arm, Chain, OFFSET, parameters, REVOLUTE
import numpy as np
from numpy.typing import NDArray
import yaml

TRIES = 12  # starts of the inverse kinematics for each view
STEPS, LARGEST_STEP = 40, 0.3  # iterations of the inverse kinematics; largest step (rad or m)
REACHED = 1e-5  # largest error of the inverse kinematics (m and rad)
OTHER = 0.5  # smallest difference of a joint between postures (rad or m)
MARGIN = 0.05  # smallest distance to the limits of the joints (rad or m)
WIDE = math.pi  # default limits
SECONDS = 5.0  # from one configuration to the next
SEED = 0


@dataclass(frozen=True, eq=False)
class Programme:
    """
    Configurations q (n, joints) of a chain, the best first.

    errors: (n + 1,) 1 sigma (m) of points predicted in other postures, before the first and after
    each configuration; enough: the number after which it is below the noise of the points.
    """

    chain: Chain
    q: Array
    errors: Array
    enough: int

    def as_csv(self) -> str:
        """Return the configurations as a table, with the columns that the verb reads."""
        units, factors = zip(*(('degrees', math.degrees(1)) if joint.kind == REVOLUTE else
                               ('mm', 1e3) for joint in self.chain.joints), strict=True)
        header = ','.join(f'{joint.name} [{unit}]' for joint, unit in zip(
            self.chain.joints, units, strict=True))
        rows = (','.join(f'{v:.4f}' for v in row) for row in self.q * factors)
        return '\n'.join([header, *rows, ''])

    def as_trajectory(self) -> str:
        """Return the configurations as a trajectory_msgs/JointTrajectory in YAML."""
        points = [{'positions': [round(float(v), 6) for v in row],
                   'time_from_start': {'sec': int(SECONDS * k), 'nanosec': 0}}
                  for k, row in enumerate(self.q, 1)]
        return str(yaml.safe_dump(
            {'joint_names': [joint.name for joint in self.chain.joints], 'points': points},
            sort_keys=False, default_flow_style=None, width=100))


def programme(fit: Fit, count: int) -> Programme:
    """Return `count` configurations, best first; raises NoPostureError."""
    rng, chain = np.random.default_rng(SEED), fit.state.arm.chain
    views, q = postures(chain, fit.data.q[fit.used], rng)
    if not len(q):
        raise NoPostureError(chain.flange)
    predicted = fit.data.with_postures(np.flatnonzero(fit.used)[views], q)
    _, J = predicted.linearised(fit.state, np.zeros((len(q), fit.root.shape[1])))
    J = J / fit.weights.noise[predicted.component][:, None]
    rows = [np.flatnonzero(predicted.block == k) for k in range(len(q))]
    covariance, candidates, chosen = fit.covariance, list(range(len(q))), list[int]()
    errors = [_spread(J, covariance, fit, rows)]
    while candidates and len(chosen) < count:
        gains = [np.linalg.slogdet(np.eye(len(A)) + A @ covariance @ A.T)[1]
                 for A in (J[rows[k]] for k in candidates)]
        best = candidates.pop(int(np.argmax(gains)))
        chosen.append(best)
        A = J[rows[best]] @ covariance
        covariance = covariance - A.T @ np.linalg.solve(
            np.eye(len(A)) + A @ J[rows[best]].T, A)
        errors.append(_spread(J, covariance, fit, rows))
    certain = np.append(np.array(errors) < fit.noise_rms, True)
    return Programme(chain, q[chosen], np.array(errors), int(np.argmax(certain)))


def _spread(J: Array, covariance: Array, fit: Fit, rows: Sequence[NDArray[np.intp]]) -> float:
    """Return the RMS uncertainty (m) of points in all these postures."""
    variance = np.einsum('mi,mi->m', J @ covariance, J)
    per_sigma = fit.noise_rms / max(float(np.sqrt(np.mean(fit.residuals ** 2))), 1e-9)
    by_posture = [variance[posture_rows].mean() for posture_rows in rows]
    return float(np.sqrt(np.mean(by_posture))) * per_sigma


def postures(chain: Chain, q: Array, rng: np.random.Generator) -> tuple[NDArray[np.intp], Array]:
    """Return which (m,) of configurations (n, joints) have other postures, and these postures."""
    offsets = parameters(chain, (OFFSET,))
    arm, views = Arm(chain, offsets, np.zeros(len(offsets))), np.repeat(np.arange(len(q)), TRIES)
    lower, upper = np.array([(joint.lower, joint.upper) for joint in chain.joints]).T
    low, high = np.maximum(lower + MARGIN, -WIDE), np.minimum(upper - MARGIN, WIDE)
    goals = chain.forward(q)[views]
    solutions = rng.uniform(low, high, (len(views), len(low)))
    for _ in range(STEPS):
        T, twists = arm.with_twists(solutions)
        error = np.concatenate([goals[:, :3, 3] - T[:, :3, 3], se3.log_rotation(
            goals[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2))], axis=1)
        square = twists @ np.swapaxes(twists, 1, 2) + 1e-8 * np.eye(6)
        step = np.einsum('nij,ni->nj', twists, np.linalg.solve(square, error[..., None])[..., 0])
        solutions = solutions + np.clip(step, -LARGEST_STEP, LARGEST_STEP)
    turning = np.array([joint.kind == REVOLUTE for joint in chain.joints])
    solutions = np.where(turning & ((solutions < low) | (solutions > high)),
                         (solutions + np.pi) % (2 * np.pi) - np.pi, solutions)
    free = all(joint.follows == joint.name for joint in chain.joints)
    good = ((np.abs(error).max(axis=1) < REACHED) & (solutions > low).all(axis=1) & free
            & (solutions < high).all(axis=1))
    distinct: list[int] = []
    for k in np.flatnonzero(good):
        known = [q[views[k]], *(solutions[i] for i in distinct if views[i] == views[k])]
        if all(np.abs(solutions[k] - known_q).max() > OTHER for known_q in known):
            distinct.append(int(k))
    return views[distinct], solutions[distinct]
