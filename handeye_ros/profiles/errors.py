"""What a profile does not show."""
from __future__ import annotations

from handeye_ros.errors import DataError, mm


class FeatureError(DataError):
    """A profile does not show what the method needs; the message says what is missing."""


class DisagreeingProfilesError(FeatureError):
    """The profiles of one stop show the target at different places."""

    def __init__(self, what: str, apart: float) -> None:
        super().__init__(f'the profiles of this station do not agree on {what}: they are '
                         f'{mm(apart)} apart; something moved, or some of them show another '
                         'object; take the sample again')
