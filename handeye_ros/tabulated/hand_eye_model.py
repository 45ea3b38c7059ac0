"""
A X = X B: residuals of measured poses given X and the fixed target Z, and their noise.

T (n, 4, 4) is the mount of the camera in the frame where the target is fixed: T_base_flange, or
with eye_on_base its inverse. A state is X and Z.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.estimation.least_squares import Rows, System, White
import numpy as np

MINIMUM = 3
SMALLEST_NOISE = 1e-9  # m or rad: a smaller scatter is rounding

State: TypeAlias = tuple[Array, Array]


@dataclass(frozen=True)
class PoseNoise:
    """
    1 sigma per axis: of the target's pose in the camera frame, and of the robot's pose.

    If estimated, target_translation includes the robot's: their effects are the same.
    """

    target_translation: float
    target_rotation: float
    robot_translation: float = 0.0
    robot_rotation: float = 0.0


def residuals(T: Array, T_camera_target: Array, state: State) -> Array:
    """Return the (n, 6) differences of measured and predicted views in the camera frame."""
    X, Z = state
    predicted = se3.inverse(T @ X) @ Z
    turned = T_camera_target[:, :3, :3] @ np.swapaxes(predicted[:, :3, :3], 1, 2)
    return np.concatenate([T_camera_target[:, :3, 3] - predicted[:, :3, 3],
                           se3.log_rotation(turned)], axis=1)


def derivatives(T: Array, state: State, eye_on_base: bool = False) -> tuple[Array, Array]:
    """
    Return the derivatives of the residuals by X and Z (n, 6, 12), and by the poses (n, 6, 6).

    A pose error is a shift and a rotation about the flange, along the axes of T's parent.
    """
    X, Z = state
    to_camera = np.swapaxes(T[:, :3, :3] @ X[:3, :3], 1, 2)
    in_mount = se3.apply(se3.inverse(T), Z[None, :3, 3])[:, 0]
    J, G = np.zeros((len(T), 6, 12)), np.zeros((len(T), 6, 6))
    R_t = X[:3, :3].T
    J[:, :3, :3], J[:, :3, 3:6] = R_t, -R_t @ se3.skew(in_mount - X[:3, 3])
    J[:, 3:, 3:6] = R_t
    J[:, :3, 6:9], J[:, 3:, 9:] = -to_camera, -to_camera
    G[:, :3, :3], G[:, 3:, 3:] = to_camera, to_camera
    flange = 0.0 if eye_on_base else T[:, :3, 3]
    G[:, :3, 3:] = -to_camera @ se3.skew(Z[:3, 3] - flange)
    return J, G


def factors(T: Array, state: State, noise: PoseNoise, eye_on_base: bool) -> Array:
    """Return the roots (n, 6, 6), by Cholesky, of the covariances of the residuals."""
    _, G = derivatives(T, state, eye_on_base)
    G = G * np.repeat([noise.robot_translation, noise.robot_rotation], 3)
    own = np.repeat([noise.target_translation, noise.target_rotation], 3)
    return np.linalg.cholesky(G @ np.swapaxes(G, 1, 2) + np.diag(own ** 2))


def system(T: Array, T_camera_target: Array, noise: PoseNoise, eye_on_base: bool
           ) -> System[State]:
    """Return the least-squares system of X and Z; each pose is a block."""
    n = len(T)

    def rows(state: State) -> Rows:
        def white() -> White:
            inverse = np.linalg.inv(factors(T, state, noise, eye_on_base))
            return lambda values: (inverse @ values.reshape(n, 6, -1)).reshape(values.shape)
        return Rows(residuals(T, T_camera_target, state).ravel(),
                    lambda: derivatives(T, state)[0].reshape(6 * n, 12), white)

    def retract(state: State, step: Array) -> State:
        return se3.perturb(state[0], step[:6]), se3.perturb(state[1], step[6:])
    return System(rows, retract, np.repeat(np.arange(n), 6))


def causes(T: Array, state: State, eye_on_base: bool) -> Array:
    """
    Return the covariances (3, n, 6, 6) of the residuals for unit variances of each cause.

    Causes: translation (of target and robot together, as their effects are the same), rotation of
    the target, rotation of the robot (which also shifts the target).
    """
    own = np.broadcast_to(np.eye(6), (len(T), 6, 6))
    by_turn = derivatives(T, state, eye_on_base)[1][:, :, 3:]
    return np.array([own * ([1] * 3 + [0] * 3), own * ([0] * 3 + [1] * 3),
                     by_turn @ np.swapaxes(by_turn, 1, 2)])


def noise_of(variances: Array) -> PoseNoise:
    """Return the noise with the variances (3,) of the causes."""
    shift, turn, robot_turn = np.maximum(np.sqrt(variances), SMALLEST_NOISE).tolist()
    return PoseNoise(shift, turn, robot_rotation=robot_turn)
