"""Files of measured values that cannot be read or solved."""
from __future__ import annotations

from handeye_ros.errors import DataError, InputError


class TableError(InputError):
    """A file of measured values that cannot be read."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path}: {reason}')


class DegenerateError(DataError):
    """Measured values that leave something open, or contradict each other."""

    def __init__(self, method: str, reason: str, advice: str) -> None:
        super().__init__(f'{method} cannot be solved: {reason}; {advice}')
