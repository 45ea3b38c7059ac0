"""Files of measured values that cannot be solved."""
from __future__ import annotations

from handeye_ros.errors import DataError


class DegenerateError(DataError):
    """Measured values that do not determine the answer, or contradict each other."""

    def __init__(self, method: str, reason: str, advice: str) -> None:
        super().__init__(f'{method} cannot be solved: {reason}; {advice}')
