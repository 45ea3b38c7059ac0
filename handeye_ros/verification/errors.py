"""Refusals of verifications and checks."""
from __future__ import annotations

from collections.abc import Sequence

from handeye_ros.errors import DataError, InputError, mm


def any_of(counts: Sequence[int]) -> str:
    """Return the valid counts in words."""
    if len(counts) > 3:
        return f'{counts[0]} to {counts[-1]}'
    return ' or '.join(map(str, sorted(counts)))


class WrongCountError(InputError):
    """A routine with a wrong number of bags or lengths (items)."""

    def __init__(self, routine: str, items: str, count: int, needed: str) -> None:
        super().__init__(f'{routine} needs {needed} {items}, and got {count}')


class TooFewSeenError(DataError):
    """Too few stations for a verification."""

    def __init__(self, stations: int, minimum: int, reason: str) -> None:
        super().__init__(f'{stations} usable stations, fewer than {minimum}'
                         + (f' (of the others: {reason})' if reason else '')
                         + ': measure more, with the sensor turned differently at each')


class SameRecordingError(InputError):
    """Two recordings of a verification with the same stops; their numbers, from 1."""

    def __init__(self, first: int, second: int) -> None:
        super().__init__(f'recordings {first} and {second} hold the same stops (equal stamps): '
                         'give one recording of each face or ball')


class BadCovarianceError(InputError):
    """A calibration whose covariance is not positive semidefinite."""

    def __init__(self) -> None:
        super().__init__('the covariance of the calibration has a negative variance, so it is '
                         'not valid: use the calibration.yaml as it was written')


class NotTheArtefactError(DataError):
    """Points that do not have the shape of the artefact for any calibration."""

    def __init__(self, routine: str, distance: float) -> None:
        super().__init__(
            f'this is not what "{routine}" measures: no error of the calibration brings all '
            f'points closer than {mm(distance)} to its shape. Check which object was under the '
            'sensor, that it did not move, and that nothing else was in view (--near)')


class NoAnswerError(DataError):
    """A verification without a verdict."""

    def __init__(self, verdict: str, reasons: Sequence[str]) -> None:
        super().__init__(f'{verdict}: ' + '; '.join(reasons))


class NoRoutineError(InputError):
    """A verification without a routine."""

    def __init__(self) -> None:
        super().__init__('verify.routine is not set, so there is nothing to measure: set it to '
                         'the artefact under the sensor (docs/measure.md)')


class NothingToVerifyError(DataError):
    """A verification without a calibration."""

    def __init__(self) -> None:
        super().__init__('there is no calibration to verify: call ~/compute_calibration, or set '
                         'verify.calibration to the file of one')


class NotStartedError(DataError):
    """A result was requested of a verification that was not started."""

    def __init__(self) -> None:
        super().__init__('no verification was started: call ~/verify_start, stop at several '
                         'poses, and ask again')


class UnusableStopError(DataError):
    """A stop that a verification cannot use, with the reason."""

    def __init__(self, reason: str) -> None:
        super().__init__(f'the stop does not count for the verification: {reason}')


class TooLongPassError(DataError):
    """A pass with more poses than can be stored."""

    def __init__(self, limit: int) -> None:
        super().__init__(f'a pass has more than {limit} poses, and not all are kept: set '
                         'verify.routine again to start over, and scan in shorter passes')


class NoTeethError(DataError):
    """Points not on the gauge; on_gauge, on_face: the fraction on it, and on its rarest faces."""

    def __init__(self, pitch: float, height: float, on_gauge: float, on_face: float) -> None:
        super().__init__(
            f'this is not the gauge: {on_gauge:.0%} of the points lie on teeth of pitch '
            f'{mm(pitch)} and height {mm(height)}, and {on_face:.1%} on their flats or on their '
            'flanks. Give both lengths (--length PITCH --length HEIGHT), and scan the gauge alone')


class NoCheckError(InputError):
    """A calibration file without the values that a check compares with."""

    def __init__(self, method: str, methods: Sequence[str]) -> None:
        super().__init__(
            f'the calibration (method {method}) does not hold what a check compares with: the '
            'target with its covariance. Solve its recording again with this version, as one of '
            f'{", ".join(methods)}, or measure a known object with "handeye verify"')


class NothingToCheckError(InputError):
    """A check without recordings or without a calibration."""

    def __init__(self) -> None:
        super().__init__('nothing to check: give "handeye check BAG... --against '
                         'calibration.yaml", or --folder DIR for the trend of many calibrations')
