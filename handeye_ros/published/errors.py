"""What the published algorithms cannot work from."""
from __future__ import annotations

from handeye_ros.errors import DataError


class TooFewError(DataError):
    """A published algorithm was given less than it can work from."""

    def __init__(self, method: str, minimum: int, what: str, count: int) -> None:
        super().__init__(f'{method} needs at least {minimum} {what}, got {count}')


class SingularError(DataError):
    """A published algorithm divides by what the data make zero."""

    def __init__(self, method: str, reason: str) -> None:
        super().__init__(f'{method} cannot be solved: {reason}')
