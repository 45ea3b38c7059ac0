"""What scans and seams refuse."""
from __future__ import annotations

from collections.abc import Sequence

from handeye_ros.errors import DataError, InputError, mm


class CloudFileError(InputError):
    """A cloud that cannot be read."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path}: {reason}')


class CloudFormatError(InputError):
    """A file whose name says no form of a cloud that is known."""

    def __init__(self, path: object, known: Sequence[str]) -> None:
        super().__init__(f'{path}: the file name must end with '
                         f'{" or ".join(known)}')


class NoPosesAroundError(DataError):
    """A scan of which no profile has a pose."""

    def __init__(self, profiles: int, gap: float) -> None:
        super().__init__(f'none of the {profiles} profiles has a pose before and after it within '
                         f'{gap:g} s: the clocks of sensor and robot differ (set time_offset), or '
                         'the poses are too sparse (sampling.max_pose_gap)')


class EmptyScanError(DataError):
    """A scan that no point is left of."""

    def __init__(self, profiles: int, returns: int) -> None:
        super().__init__(f'no point is left of {profiles} profiles with {returns} returns: '
                         + ('widen the limits (--range, --incidence)' if returns else
                            'the sensor saw nothing; check its range and exposure'))


def place(point: Sequence[float]) -> str:
    """Return where a point lies, for a person."""
    return 'x y z = ' + ' '.join(f'{v * 1e3:.0f}' for v in point) + ' mm'


class NoSeamError(DataError):
    """A cloud without a seam."""

    def __init__(self, spacing: float, widest: float) -> None:
        super().__init__(
            f'no seam: nowhere do two edges face each other within {mm(widest)} (--widest). The '
            f'points are {mm(spacing)} apart, so a gap or step must be larger than '
            f'{mm(4 * spacing)} to be seen: scan more densely, or check what was scanned')


class TooFewPointsError(DataError):
    """A cloud of so few points that nothing can be seen in it."""

    def __init__(self, count: int, least: int) -> None:
        super().__init__(f'the cloud has {count} different points, fewer than {least}: scan more '
                         'densely, or widen --box')


class SeveralSeamsError(DataError):
    """A cloud with more than one seam; places: (3,) of each."""

    def __init__(self, lengths: Sequence[float], places: Sequence[Sequence[float]]) -> None:
        listed = '; '.join(f'{mm(length)} long at {place(p)}'
                           for length, p in zip(lengths, places, strict=True))
        super().__init__(f'{len(lengths)} seams ({listed}): cut one out with --box')


class InterruptedSeamError(DataError):
    """A seam that is not seen in one piece."""

    def __init__(self, size: float, at: Sequence[float]) -> None:
        super().__init__(f'the seam is not seen for {mm(size)} at {place(at)}: scan there again, '
                         'or cut one part out with --box')


class NoLineError(DataError):
    """Facing edges that do not form a line: a closed seam, a branch, a narrow strip."""

    def __init__(self, width: float, at: Sequence[float]) -> None:
        super().__init__(f'what looks like a seam is not a single open line: it is {mm(width)} '
                         f'wide at {place(at)} (closed, or branching?): cut a part out with --box')


class HiddenWallError(DataError):
    """A step that may be a lap or a T, since its wall is not seen."""

    def __init__(self, height: float, at: Sequence[float]) -> None:
        super().__init__(f'a step of {mm(height)} at {place(at)} whose wall is not seen: too high '
                         'for a lap, and the root of a T cannot be found without it: scan with '
                         'the sensor leant by 30 to 45 degrees towards the wall')


class UnclearSeamError(DataError):
    """A seam whose sections do not agree; spread: of them, noise: of the points."""

    def __init__(self, spread: float, noise: float) -> None:
        super().__init__(f'the sections of the seam scatter by {mm(spread)}, and the points by '
                         f'{mm(noise)}: this is not a uniform seam; cut it out with --box, '
                         'or scan more densely')


class UncertainSeamError(DataError):
    """A seam of which no frame is known well enough; std: 1 sigma of most."""

    def __init__(self, std: float) -> None:
        super().__init__(f'the seam is known to {mm(std)} (1 sigma) only, '
                         'which is too little for a path: scan more densely, or with less noise')


class TaughtPathError(InputError):
    """A taught path that cannot be read."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path}: {reason}; expected a CSV file with columns x, y, z in metres')


class NeedsCalibrationError(InputError):
    """A bag whose profiles cannot be put into the base."""

    def __init__(self, path: object) -> None:
        super().__init__(f'{path} is no .ply or .pcd file; to use it as a bag, say which '
                         'calibration puts its profiles into the base: --calibration FILE')
