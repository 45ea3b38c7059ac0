"""Refusals of reading files."""
from __future__ import annotations

from handeye_ros.errors import InputError


class CalibrationFileError(InputError):
    """A calibration file that cannot be read."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path} cannot be used: {reason}')


class VerificationFileError(InputError):
    """A file of a verification that cannot be read."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path} is no result of "handeye verify --out": {reason}')
