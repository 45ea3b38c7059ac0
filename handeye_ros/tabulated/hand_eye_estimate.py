"""
A X = X B from any number of poses of robot and target (CN105021139A).

The start is a closed form: rotation from the rotation axes of all pairs of poses, then a linear
translation. Least squares over rotation and translation together follow: for each view the pose
predicted by T_base_flange, X and the fixed target Z is compared with the measured one.
"""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from handeye_ros import se3
from handeye_ros.checks.consistency import require_rotations
from handeye_ros.data import Array
from handeye_ros.errors import DataError, TooFewError
from handeye_ros.estimation.outliers import (
    adjust,
    Adjusted,
    first_variances,
    variance_components,
)
from handeye_ros.tables import Table
from handeye_ros.tabulated.hand_eye_model import (
    causes,
    derivatives,
    factors,
    MINIMUM,
    noise_of,
    PoseNoise,
    residuals,
    State,
    system,
)
import numpy as np
from numpy.typing import NDArray

__all__ = ['HandEyeResult', 'PoseNoise', 'closed_form', 'read', 'residuals', 'solve']

NAME = 'A X = X B'
MOST_PAIRS = 2000
LARGEST_ANGLE = 3.0  # angle above which a rotation axis is uncertain (rad)
SUBSETS = 20
SUBSET_SIZE = 4
BELIEVED_SHARE = 0.7
SUSPECT = 16.0  # squared residual over the median above which outliers are suspected
LARGEST_DROPPED_SHARE = 0.34
LARGEST_RMS = (1e-2, 0.05)  # largest of a trusted answer (m, rad)
LENGTH = 0.1  # m that weigh as much as a radian, until the noise is estimated
ROUNDS = 2  # of estimating the noise
LOST = 'the position along it is free'


@dataclass(frozen=True, eq=False)
class HandEyeResult:
    """
    The result.

    T_flange_camera, T_base_target: (4, 4), with eye_on_base T_base_camera and T_flange_target;
    covariance: (6, 6) of the first, x y z rx ry rz in its parent; used: indices of the used poses;
    noise: given or estimated; rms: RMS (translation (m), rotation (rad)) of the used views;
    holdout_rms: the same, each view predicted without itself.
    """

    T_flange_camera: Array
    T_base_target: Array
    covariance: Array
    used: NDArray[np.intp]
    noise: PoseNoise
    rms: tuple[float, float]
    holdout_rms: tuple[float, float]


def read(path: Path, angles: str = '') -> tuple[Array, Array]:
    """
    Return T_base_flange and T_camera_target (n, 4, 4) of a file.

    Columns flange_x ... and target_x ... as in Table.poses, each with its unit; angles: how a
    controller writes the poses of the flange. Raises TableError.
    """
    table = Table(path)
    return table.poses('flange', angles), table.poses('target')


def solve(T_base_flange: Array, T_camera_target: Array, noise: PoseNoise | None = None,
          eye_on_base: bool = False, frame: str = '') -> HandEyeResult:
    """
    Return the hand-eye transform.

    T_base_flange, T_camera_target: (n, 4, 4), pairwise at the same times; noise: estimated if not
    given; eye_on_base: the camera is fixed to the base, the target to the flange; frame: name of
    the frame that the camera is fixed in, for messages.
    Raises TooFewError, OneOrientationError, OneAxisError, DataError.
    """
    T = se3.inverse(T_base_flange) if eye_on_base else T_base_flange
    if len(T) < MINIMUM:
        raise TooFewError(NAME, MINIMUM, 'poses', len(T))
    frame = frame or ('base' if eye_on_base else 'flange')
    require_rotations(T, frame, LOST)
    start = _start(T, T_camera_target)
    fit, noise = _with_noise(T, T_camera_target, start, noise, eye_on_base)
    X, Z = fit.state
    L = factors(T, fit.state, noise, eye_on_base)[fit.used]
    rms = _rms(L, fit.residuals[fit.used])
    _require_agreement(len(T) - len(fit.used), len(T), rms)
    require_rotations(T[fit.used], frame, LOST)
    return HandEyeResult(X, Z, fit.covariance[:6, :6], fit.used, noise, rms,
                         _rms(L, fit.left_out))


def _require_agreement(dropped: int, total: int, rms: tuple[float, float]) -> None:
    if dropped > LARGEST_DROPPED_SHARE * total or rms[0] > LARGEST_RMS[0] or (
            rms[1] > LARGEST_RMS[1]):
        raise DataError(
            f'{NAME} cannot be solved: {dropped} of {total} poses contradict the others, which '
            f'agree to {rms[0] * 1e3:.3g} mm and {np.degrees(rms[1]):.3g} degrees RMS; check '
            'that both lists are of the same moments, that no pose is inverted, and the units')


def _rms(factors: Array, white: Array) -> tuple[float, float]:
    """Return the RMS length of translations and rotations of whitened residuals (n, 6)."""
    plain = np.einsum('nij,nj->ni', factors, white)
    squares = (plain ** 2).reshape(-1, 2, 3).sum(axis=2).mean(axis=0)
    return float(squares[0] ** 0.5), float(squares[1] ** 0.5)


def closed_form(T: Array, T_camera_target: Array) -> State:
    """
    Return X and Z from all pairs of poses (n, 4, 4), rotation first.

    Park and Martin 1994 (IEEE Trans. Robotics and Automation 10:717), least squares throughout.
    """
    i, j = np.triu_indices(len(T), 1)
    some = np.linspace(0, len(i) - 1, min(len(i), MOST_PAIRS)).astype(int)
    A = se3.inverse(T[j[some]]) @ T[i[some]]
    B = T_camera_target[j[some]] @ se3.inverse(T_camera_target[i[some]])
    a, b = se3.log_rotation(A[:, :3, :3]), se3.log_rotation(B[:, :3, :3])
    sure = np.maximum(np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)) < LARGEST_ANGLE
    R = se3.nearest_rotation(a[sure].T @ b[sure])
    M = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    t = np.linalg.lstsq(M, (B[:, :3, 3] @ R.T - A[:, :3, 3]).ravel(), rcond=None)[0]
    X = se3.transform(R, t)
    return X, se3.mean_pose(T @ X @ T_camera_target)


def _start(T: Array, T_camera_target: Array) -> State:
    """Return the closed form of all poses, or of the best few if some are outliers."""
    everything = closed_form(T, T_camera_target)
    squares = _squares(T, T_camera_target, everything)
    if len(T) <= SUBSET_SIZE or squares.max() < SUSPECT * np.median(squares):
        return everything
    rng, states = np.random.default_rng(0), [everything]
    for _ in range(SUBSETS):
        some = rng.permutation(len(T))[:SUBSET_SIZE]
        states.append(closed_form(T[some], T_camera_target[some]))
    return min(states, key=lambda state: float(np.quantile(
        _squares(T, T_camera_target, state), BELIEVED_SHARE)))


def _squares(T: Array, T_camera_target: Array, state: State) -> Array:
    """Return the squared residuals (n,), translations in units of LENGTH."""
    r = residuals(T, T_camera_target, state) / np.repeat([LENGTH, 1.0], 3)
    return np.asarray((r ** 2).sum(axis=1))


def _with_noise(T: Array, T_camera_target: Array, start: State, noise: PoseNoise | None,
                eye_on_base: bool) -> tuple[Adjusted[State], PoseNoise]:
    """Return the least-squares state, and the given noise or the noise of its residuals."""
    def adjusted(state: State, noise: PoseNoise) -> Adjusted[State]:
        return adjust(system(T, T_camera_target, noise, eye_on_base), state, MINIMUM)

    if noise is not None:
        return adjusted(start, noise), noise
    r, parts = residuals(T, T_camera_target, start), causes(T, start, eye_on_base)
    fit = adjusted(start, noise_of(first_variances(r, parts)))
    for _ in range(ROUNDS):
        r = residuals(T, T_camera_target, fit.state)[fit.used]
        J = derivatives(T, fit.state)[0][fit.used]
        parts = causes(T, fit.state, eye_on_base)[:, fit.used]
        noise = noise_of(variance_components(r, J, parts, first_variances(r, parts)))
        fit = adjusted(fit.state, noise)
    assert noise
    return fit, noise
