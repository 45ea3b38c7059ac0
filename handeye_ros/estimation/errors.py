"""What keeps an estimate from being started."""
from __future__ import annotations

from handeye_ros.errors import DataError


class NoGuessError(DataError):
    """No estimate could be started."""

    def __init__(self, why: str) -> None:
        super().__init__(f'no estimate can be started: {why}')
