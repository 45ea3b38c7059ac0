"""
The usual slips with pose conventions, tried out when an answer does not fit.

Each is a map of poses (n, 4, 4) to what they would be had the slip been made on the way here;
the one that makes the samples agree names the mistake.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from handeye_ros import se3
from handeye_ros.checks.errors import RangeSignError, ScatteredOrientationsError, SlipError
from handeye_ros.checks.misfit import (
    dropped_share,
    LARGEST_DROPPED_SHARE,
    misfit_of,
    residual_rms,
    SUSPICIOUS,
)
from handeye_ros.data import Array
from handeye_ros.errors import HandeyeError
from handeye_ros.estimation.problem import Problem
from handeye_ros.estimation.robust import Consensus, consensus
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import f as f_distribution

DOUBTFUL = 3.0  # variance factor from which the other sign of the range is tried
BELIEVABLE = 4.0  # that a slip must lead to
CHANCE = 1e-5  # of naming a slip where there is none
SCATTERED = 0.6  # mean of the cosines to the best direction, below which there is none


def _inverse(T: Array) -> Array:
    return se3.inverse(T)


def _wxyz(T: Array) -> Array:
    """Undo x y z w having been filled in the order w x y z."""
    w, x, y, z = np.moveaxis(Rotation.from_matrix(T[:, :3, :3]).as_quat(), -1, 0)
    return se3.from_quaternion(T[:, :3, 3], np.column_stack([x, y, z, w]))


def _millimetres(T: Array) -> Array:
    return se3.transform(T[:, :3, :3], T[:, :3, 3] / 1e3)


def _metres_as_millimetres(T: Array) -> Array:
    return se3.transform(T[:, :3, :3], T[:, :3, 3] * 1e3)


def _intrinsic(T: Array) -> Array:
    """Undo extrinsic x y z angles having been composed as intrinsic ones."""
    angles = Rotation.from_matrix(T[:, :3, :3]).as_euler('XYZ')
    return se3.transform(Rotation.from_euler('xyz', angles).as_matrix(), T[:, :3, 3])


def _extrinsic(T: Array) -> Array:
    """Undo intrinsic X Y Z angles having been composed as extrinsic ones."""
    angles = Rotation.from_matrix(T[:, :3, :3]).as_euler('xyz')
    return se3.transform(Rotation.from_euler('XYZ', angles).as_matrix(), T[:, :3, 3])


def _radians_as_degrees(T: Array) -> Array:
    """Undo roll, pitch, yaw in radians having been read as degrees."""
    angles = Rotation.from_matrix(T[:, :3, :3]).as_euler('xyz')
    return se3.transform(Rotation.from_euler('xyz', np.degrees(angles)).as_matrix(), T[:, :3, 3])


def _rotation_inverted(T: Array) -> Array:
    return se3.transform(np.swapaxes(T[:, :3, :3], 1, 2), T[:, :3, 3])


SLIPS: dict[str, tuple[Callable[[Array], Array], str]] = {
    'inverse poses': (_inverse, 'publish the pose of the flange in the base '
                      '(p_base = T p_flange), not its inverse'),
    'quaternions read as w x y z': (_wxyz, 'fill x, y, z, w of the message by name, not in the '
                                    'order w x y z'),
    'positions in millimetres': (_millimetres, 'publish positions in metres'),
    'positions a thousand times larger': (_metres_as_millimetres, 'publish positions in metres: '
                                          'these were divided by 1000 once too often'),
    'extrinsic Euler angles': (_intrinsic, 'the angles were composed as intrinsic x-y-z; '
                               'compose them as extrinsic x-y-z (Rz Ry Rx)'),
    'intrinsic Euler angles': (_extrinsic, 'the angles were composed as extrinsic x-y-z; '
                               'compose them as intrinsic x-y-z (Rx Ry Rz)'),
    'angles in radians': (_radians_as_degrees, 'the angles are radians but were converted as '
                          'degrees; convert them once only'),
    'transposed rotations': (_rotation_inverted, 'publish the rotation of the flange in the '
                             'base, not its transpose'),
}


def require_no_slip(problem: Problem, agreed: Consensus, flipped: Problem | None,
                    rng: np.random.Generator) -> None:
    """
    Refuse an answer that a slip in the conventions explains better.

    flipped: the problem with the range counted the other way, if it can be posed.

    Raises RangeSignError, SlipError or ScatteredOrientationsError.
    """
    misfit = misfit_of(problem, agreed)
    if not misfit.hopeless and misfit.variance_factor < DOUBTFUL:
        return
    rms = misfit.rms
    other = _tried(flipped, rng) if flipped else None
    if flipped and other and _explains(flipped, other, agreed):
        raise RangeSignError(flipped.config.profile.range_sign, rms, residual_rms(other.solution))
    if not misfit.hopeless and misfit.variance_factor < SUSPICIOUS:
        return
    tried = {name: _tried(replace(problem, poses=undo(problem.poses)), rng)
             for name, (undo, _) in SLIPS.items()}
    good = {name: better for name, better in tried.items()
            if better and _explains(problem, better, agreed)}
    if good:
        name = min(good, key=lambda key: good[key].solution.variance_factor)
        raise SlipError(name, rms, residual_rms(good[name].solution), SLIPS[name][1])
    if misfit.hopeless and orientations_scatter(problem.poses):
        raise ScatteredOrientationsError(rms)


def orientations_scatter(poses: Array) -> bool:
    """
    Return whether no direction of the tool keeps to a side, in poses (n, 4, 4).

    A sensor that sees its target does keep to a side; wrapped angles are as good as random.
    """
    return float(np.linalg.norm(poses[:, :3, :3].mean(axis=0), 2)) < SCATTERED


def _tried(problem: Problem, rng: np.random.Generator) -> Consensus | None:
    try:
        return consensus(problem, rng)
    except (HandeyeError, np.linalg.LinAlgError):
        return None


def _explains(problem: Problem, better: Consensus, agreed: Consensus) -> bool:
    """
    Return whether a slip explains what the answer does not, down to the configured noise.

    By an F-test: few stations fit many things by chance.
    """
    if dropped_share(problem, better) > LARGEST_DROPPED_SHARE or (
            better.solution.variance_factor > BELIEVABLE
            or len(better.used) < 0.8 * len(agreed.used)):
        return False
    gain = agreed.solution.variance_factor / max(better.solution.variance_factor, 1.0)
    freedom = (agreed.solution.degrees_of_freedom, better.solution.degrees_of_freedom)
    if min(freedom) < 1:
        return False
    more = len(better.used) - len(agreed.used)
    return gain > float(f_distribution.isf(CHANCE, *freedom)) or (
        gain > 0.1 and more > 0.3 * len(problem.poses))
