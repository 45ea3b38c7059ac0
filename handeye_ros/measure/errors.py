"""What measuring with a calibration refuses."""
from __future__ import annotations

from collections.abc import Sequence

from handeye_ros.errors import DataError, InputError


class CloudFileError(InputError):
    """A cloud that cannot be read."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path}: {reason}')


class CloudFormatError(InputError):
    """A file whose name says no form of a cloud that is known."""

    def __init__(self, path: object, known: Sequence[str]) -> None:
        super().__init__(f'{path}: the ending says the form of a cloud; expected '
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
