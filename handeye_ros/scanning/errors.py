"""Refusals of scans and seams."""
from __future__ import annotations

from collections.abc import Sequence

from handeye_ros.errors import DataError, InputError, mm


class CloudFileError(InputError):
    """A cloud that cannot be read."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path}: {reason}')


class CloudFormatError(InputError):
    """A file name without a known extension of point clouds."""

    def __init__(self, path: object, extensions: Sequence[str]) -> None:
        super().__init__(f'{path}: the file name must end with '
                         f'{" or ".join(extensions)}')


class NoPosesAroundError(DataError):
    """A scan without a pose for any profile."""

    def __init__(self, profiles: int, gap: float) -> None:
        super().__init__(f'none of the {profiles} profiles has a pose before and after it within '
                         f'{gap:g} s: the clocks of sensor and robot differ (set time_offset), or '
                         'the poses are too sparse (sampling.max_pose_gap)')


class EmptyScanError(DataError):
    """A scan without points after all limits."""

    def __init__(self, profiles: int, returns: int) -> None:
        super().__init__(f'no point is left of {profiles} profiles with {returns} returns: '
                         + ('widen the limits (--range, --incidence)' if returns else
                            'the sensor saw nothing; check its range and exposure'))


def position_text(point: Sequence[float]) -> str:
    """Return the position of a point in words."""
    return 'x y z = ' + ' '.join(f'{v * 1e3:.0f}' for v in point) + ' mm'


class NoSeamError(DataError):
    """A cloud without a seam."""

    def __init__(self, spacing: float, widest: float) -> None:
        super().__init__(
            f'no seam: nowhere do two edges face each other within {mm(widest)} (--widest). The '
            f'points are {mm(spacing)} apart, so a gap or step must be larger than '
            f'{mm(4 * spacing)} to be seen: scan more densely, or check what was scanned')


class TooFewPointsError(DataError):
    """A cloud with too few points."""

    def __init__(self, count: int, minimum: int) -> None:
        super().__init__(f'the cloud has {count} different points, fewer than {minimum}: scan '
                         'more densely, or widen --box')


class SeveralSeamsError(DataError):
    """A cloud with more than one seam; positions: (3,) of each."""

    def __init__(self, lengths: Sequence[float], positions: Sequence[Sequence[float]]) -> None:
        listed = '; '.join(f'{mm(length)} long at {position_text(position)}'
                           for length, position in zip(lengths, positions, strict=True))
        super().__init__(f'{len(lengths)} seams ({listed}): cut one out with --box')


class InterruptedSeamError(DataError):
    """A seam that is visible only in parts."""

    def __init__(self, size: float, position: Sequence[float]) -> None:
        super().__init__(f'the seam is not seen for {mm(size)} at {position_text(position)}: scan '
                         'there again, or cut one part out with --box')


class NoLineError(DataError):
    """Facing edges that do not form a line: a closed seam, a branch, a narrow strip."""

    def __init__(self, width: float, position: Sequence[float]) -> None:
        super().__init__(f'what looks like a seam is not a single open line: it is {mm(width)} '
                         f'wide at {position_text(position)} (closed, or branching?): cut a part '
                         'out with --box')


class HiddenWallError(DataError):
    """A step that may be a lap or a T joint, since its wall is hidden."""

    def __init__(self, height: float, position: Sequence[float]) -> None:
        super().__init__(
            f'a step of {mm(height)} at {position_text(position)} whose wall is not seen: too '
            'high for a lap, and the root of a T cannot be found without it: scan with the sensor '
            'tilted by 30 to 45 degrees towards the wall')


class UnclearSeamError(DataError):
    """A seam with inconsistent sections; spread: of the sections, noise: of the points."""

    def __init__(self, spread: float, noise: float) -> None:
        super().__init__(f'the sections of the seam scatter by {mm(spread)}, and the points by '
                         f'{mm(noise)}: this is not a uniform seam; cut it out with --box, '
                         'or scan more densely')


class UncertainSeamError(DataError):
    """A seam without a sufficiently certain frame; std: median 1 sigma."""

    def __init__(self, std: float) -> None:
        super().__init__(f'the position of the seam has a standard deviation of {mm(std)}, '
                         'too much for a path: scan more densely, or with less noise')


class NeedsCalibrationError(InputError):
    """A bag with profiles but without a calibration to map them to the base."""

    def __init__(self, path: object) -> None:
        super().__init__(f'{path} is no .ply or .pcd file; to use it as a bag, give the '
                         'calibration of its sensor: --calibration FILE')
