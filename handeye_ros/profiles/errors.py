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


def range_sign_hint(sign: int, as_set: int, flipped: int, total: int) -> str:
    """
    Return what to tell when the profiles show their edges only with the range flipped.

    sign: profile.range_sign as it is set; as_set, flipped: how many of the total stations show
    an edge that way, and with the range counted the other way.
    """
    return (f'with profile.range_sign {sign}, {as_set} of {total} stations show an edge; counted '
            f'the other way {flipped} of {total} do: set profile.range_sign to {-sign} (or, if it '
            'is right, remove what is higher beside the target)')
