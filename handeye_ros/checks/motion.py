"""Frames of a recording, and the motions that it lacks, in the user's terms."""
from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

from handeye_ros.checks.errors import (
    missing_spread,
    missing_turn,
    OneAxisError,
    OneOrientationError,
    SensorFrameError,
    TooFewConditionsError,
    TooFewSamplesError,
    TooUncertainError,
    UnidentifiedOutlierError,
)
from handeye_ros.config import Config, UNNAMED_FRAME
from handeye_ros.data import Array, Reject, Sample
from handeye_ros.estimation.consensus import Consensus
from handeye_ros.estimation.model import Method
from handeye_ros.estimation.solution import redundancy, Solution
from handeye_ros.frames import mount_frame
import numpy as np
from scipy.spatial.transform import Rotation

ENOUGH_TURN = 0.12  # rad: RMS about the second axis, of tilts to both sides by 12 degrees
FEWEST_REDUNDANT = 3  # conditions that judge an answer, and the choice of each dropped station
CONTAMINATED = 0.1  # probability of one of few samples being wrong that is too large
SMALLEST_TURN = 0.01  # rad: less RMS rotation about an axis counts as none
LARGEST_BESIDE = 1e-3  # m; of profiles beside their plane that need no note


def require_samples(samples: Sequence[Sample], rejects: Sequence[Reject], method: Method) -> None:
    """Raise TooFewSamplesError when there are fewer samples than the method needs."""
    if len(samples) < method.minimum:
        reasons = [reason for reason, _ in Counter(r.reason for r in rejects).most_common()]
        raise TooFewSamplesError(method.name, len(samples), method.minimum, len(rejects),
                                 reasons[0] if reasons else '')


def require_own_frame(frame_id: str, config: Config) -> None:
    """
    Refuse profiles in a frame of the robot: the result would be a transform to itself.

    frame_id: of the profiles. Raises SensorFrameError.
    """
    for key, robots in (('robot_effector_frame', config.robot_effector_frame),
                        ('robot_base_frame', config.base_frame)):
        if frame_id == robots:
            raise SensorFrameError(frame_id, key)


def frame_notes(frame: str | None, beside: float, config: Config) -> Iterator[str]:
    """
    Yield what does not fit, one sentence each.

    frame: of the profiles, None before the first; beside: how far they lie beside their plane
    (metres).
    """
    if frame == '':
        yield f'the profiles have no frame_id: the result calls their frame "{UNNAMED_FRAME}"'
    if beside > LARGEST_BESIDE:
        yield (f'the profiles lie up to {beside * 1e3:.1f} mm beside the plane of '
               f'{" and ".join(config.profile.axes)} in their frame: that coordinate is not '
               'used, and the result holds for points in the plane')


def require_rotations(poses: Array, config: Config, lost: str) -> None:
    """
    Refuse poses (n, 4, 4) that turn about no axis, or about only one.

    lost: what turns about one axis leave open.
    Raises OneOrientationError and OneAxisError.
    """
    turns, axes = turning(poses)
    frame = mount_frame(config)
    if turns[0] < SMALLEST_TURN:
        raise OneOrientationError(float(turns[0]))
    if turns[1] < SMALLEST_TURN:
        raise OneAxisError(name_direction(axes[0], frame), float(turns[0]),
                           other_axes(axes[0], frame), lost)


def turning(poses: Array) -> tuple[Array, Array]:
    """
    Return how far poses (n, 4, 4) turn (3,), RMS in rad, and about which axes (3, 3).

    Largest first; the axes are the rows, in the frame that the sensor is fixed in.
    """
    rotations = Rotation.from_matrix(poses[:, :3, :3])
    vectors = (rotations.mean().inv() * rotations).as_rotvec()
    _, s, axes = np.linalg.svd(vectors - vectors.mean(axis=0), full_matrices=len(vectors) < 3)
    turns = np.zeros(3)
    turns[:len(s)] = s / len(poses) ** 0.5
    return turns, axes


def name_direction(direction: Array, frame: str) -> str:
    """Return a direction (3,) as a person would say it: the nearest axis and how near."""
    axis = int(np.argmax(np.abs(direction)))
    away = np.degrees(np.arccos(min(1.0, abs(direction[axis]) / np.linalg.norm(direction))))
    if away < 15:
        return f'{frame} {"xyz"[axis]} within {max(1, round(away + 0.5))} degrees'
    text = ', '.join(f'{c:.2f}' for c in direction / np.linalg.norm(direction))
    return f'the direction ({text}) of {frame}'


def other_axes(direction: Array, frame: str) -> str:
    """Return the two axes of a frame that are most across a direction."""
    names = [name for _, name in sorted(zip(np.abs(direction), 'xyz', strict=True))]
    return f'{frame} {" or ".join(sorted(names[:2]))}'


def weakest(solution: Solution, frame: str) -> tuple[str, float]:
    """Return the least certain direction of the transform, in words, and its 1 sigma."""
    t_std, t_direction = worst_translation(solution.reported)
    return f'position along {name_direction(t_direction, frame)} (m)', t_std


def worst_translation(covariance: Array) -> tuple[float, Array]:
    """Return the largest 1 sigma of the translation (m) and its direction."""
    values, vectors = np.linalg.eigh(covariance[:3, :3])
    return float(np.sqrt(values[2])), vectors[:, 2]


def worst_rotation(covariance: Array) -> tuple[float, Array]:
    """Return the largest 1 sigma of the rotation (rad) and its axis."""
    values, vectors = np.linalg.eigh(covariance[3:6, 3:6])
    return float(np.sqrt(values[2])), vectors[:, 2]


def require_certain(agreed: Consensus, config: Config) -> None:
    """
    Refuse an answer that is less certain than the limits.

    Raises TooUncertainError, which names the direction and the motion that is missing.
    """
    solution, poses = agreed.solution, agreed.whole.poses
    limits, frame = config.limits, mount_frame(config)
    turn_std, axis = worst_rotation(solution.reported)
    if turn_std > limits.rotation:
        raise TooUncertainError.rotation(name_direction(axis, frame), turn_std, limits.rotation,
                                         missing_motion(poses, frame))
    shift_std, direction = worst_translation(solution.reported)
    if shift_std > limits.translation:
        raise TooUncertainError.translation(name_direction(direction, frame), shift_std,
                                            limits.translation,
                                            missing_motion(poses, frame))


def require_judged(agreed: Consensus) -> None:
    """
    Refuse an answer where too little is left to judge it by.

    Raises TooFewConditionsError, and UnidentifiedOutlierError where that would be so without the
    one sample that seems to be wrong.
    """
    dropped, left = len(agreed.dropped), redundancy(agreed.solution)
    needed = _redundant(dropped)
    if left < needed:
        raise TooFewConditionsError(len(agreed.used), dropped, left, needed)
    each = int(agreed.solution.ranks.max())
    missing = _redundant(dropped + 1) - (left - each)
    if agreed.contaminated > CONTAMINATED and missing > 0:
        raise UnidentifiedOutlierError(len(agreed.used), -(-missing // each))


def _redundant(dropped: int) -> int:
    """Return how many conditions are to judge an answer for which so many samples were dropped."""
    return FEWEST_REDUNDANT * (1 + dropped) + bool(dropped)


def missing_motion(poses: Array, frame: str) -> str:
    """Return what poses (n, 4, 4) should do that they do too little, in words."""
    turns, axes = turning(poses)
    if turns[1] > ENOUGH_TURN:
        return missing_spread()
    return missing_turn(name_direction(axes[1], frame), float(turns[1]))
