"""What a profile does not show."""
from __future__ import annotations

from handeye_ros.errors import DataError


class FeatureError(DataError):
    """A profile does not show what the method needs; the message says what is missing."""
