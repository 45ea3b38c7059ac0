"""Refusals of reading and writing results."""
from __future__ import annotations

from handeye_ros.errors import DataError, InputError


class CalibrationFileError(InputError):
    """A calibration file that cannot be read."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path} cannot be used: {reason}')


class NothingToSaveError(DataError):
    """The node was requested to save before there is an answer."""

    def __init__(self) -> None:
        super().__init__('there is no calibration to save: call ~/compute_calibration first, and '
                         'check that it succeeds')


class VerificationFileError(InputError):
    """A file of a verification that cannot be read."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path} is no result of "handeye verify --out": {reason}')
