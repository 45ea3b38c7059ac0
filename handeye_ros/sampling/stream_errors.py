"""Why messages cannot be brought into the order of their time."""
from __future__ import annotations

from handeye_ros.errors import DataError, InputError


class TwoFramesError(InputError):
    """Messages of two frames on one topic."""

    def __init__(self, kind: str, first: str, second: str) -> None:
        cannot, advice = {
            'profile': ('of one sensor', 'give each sensor its own topic'),
            'pose': ('in one robot base', 'let only one node publish them, in one frame'),
        }[kind]
        super().__init__(f'the {kind} topic carries two frames, "{first}" and "{second}": the '
                         f'{kind}s cannot be {cannot}; {advice}')


class TimeBackwardsError(DataError):
    """Stamps that start again: two runs in one recording."""

    def __init__(self, topic: str, index: int, jump: float) -> None:
        super().__init__(f'the stamps on {topic} jump back by {jump:.1f} s at message '
                         f'{index + 1}: two runs seem to be mixed (a bag recorded in a loop?); '
                         'record one run')


class ClocksApartError(DataError):
    """Profiles and poses that share no time."""

    def __init__(self, gap: float) -> None:
        super().__init__(f'profiles and poses share no time: {gap:.1f} s are between them; the '
                         'clocks of sensor and robot differ, or they were not recorded together')
