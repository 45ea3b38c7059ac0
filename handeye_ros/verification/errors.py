"""What verifications and checks refuse."""
from __future__ import annotations

from collections.abc import Sequence

from handeye_ros.errors import DataError, InputError, mm


def any_of(counts: Sequence[int]) -> str:
    """Return which counts are right, for a person."""
    if len(counts) > 3:
        return f'{counts[0]} to {counts[-1]}'
    return ' or '.join(map(str, sorted(counts)))


class WrongCountError(InputError):
    """A routine that was not given what it needs; what: bags, or lengths."""

    def __init__(self, routine: str, what: str, given: int, needed: str) -> None:
        super().__init__(f'{routine} needs {needed} {what}, and got {given}')


class NoPlanError(InputError):
    """A routine whose stops are not planned."""

    def __init__(self, routine: str, known: Sequence[str]) -> None:
        super().__init__(f'stops are planned for {", ".join(known)}, not for "{routine}": see '
                         'docs/measure.md for its passes')


class TooFewSeenError(DataError):
    """Too few stations for a verification."""

    def __init__(self, stations: int, least: int, reason: str) -> None:
        super().__init__(f'{stations} usable stations, fewer than {least}'
                         + (f' (of the others: {reason})' if reason else '')
                         + ': measure more, with the sensor turned differently at each')


class SameRecordingError(InputError):
    """Two recordings of a verification that hold the same stops; their numbers, from 1."""

    def __init__(self, first: int, second: int) -> None:
        super().__init__(f'recordings {first} and {second} hold the same stops (equal stamps): '
                         'give one recording of each face or ball')


class BadCovarianceError(InputError):
    """A calibration whose covariance is none."""

    def __init__(self) -> None:
        super().__init__('the covariance of the calibration has a negative variance, so it is '
                         'not valid: use the calibration.yaml as it was written')


class NotTheArtefactError(DataError):
    """Points that do not have the shape of the artefact, whatever the calibration."""

    def __init__(self, routine: str, distance: float) -> None:
        super().__init__(
            f'this is not what "{routine}" measures: no error of the calibration brings all '
            f'points closer than {mm(distance)} to its shape. Check which object was under the '
            'sensor, that it did not move, and that nothing else was in view (--near)')


class NoAnswerError(DataError):
    """A verification that says neither pass nor fail."""

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
    """The result of a verification that was not started."""

    def __init__(self) -> None:
        super().__init__('no verification was started: call ~/verify_start, stop at several '
                         'poses, and ask again')


class UnusableStopError(DataError):
    """A stop that a verification cannot use; reason: why."""

    def __init__(self, reason: str) -> None:
        super().__init__(f'the stop does not count for the verification: {reason}')


class TooLongPassError(DataError):
    """A pass of which not all poses could be kept; most: of them."""

    def __init__(self, most: int) -> None:
        super().__init__(f'a pass has more than {most} poses, and not all are kept: set '
                         'verify.routine again to start over, and scan in shorter passes')


class NoTeethError(DataError):
    """Points that are not those of the gauge; share: of them that are; least: of one face."""

    def __init__(self, pitch: float, height: float, share: float, least: float) -> None:
        super().__init__(
            f'this is not the gauge: {share:.0%} of the points lie on teeth of pitch {mm(pitch)} '
            f'and height {mm(height)}, and {least:.1%} on their flats or on their flanks. Give '
            'both lengths (--length PITCH --length HEIGHT), and scan the gauge alone')


class NoCheckError(InputError):
    """A calibration that does not say what a check compares with."""

    def __init__(self, method: str, known: Sequence[str]) -> None:
        super().__init__(
            f'the calibration (method {method}) does not hold what a check compares with: the '
            'target with its covariance. Solve its recording again with this version, as one of '
            f'{", ".join(known)}, or measure a known object with "handeye verify"')


class NothingToCheckError(InputError):
    """A check without what it needs."""

    def __init__(self) -> None:
        super().__init__('say what to check: "handeye check BAG... --against calibration.yaml", '
                         'or --folder DIR for the trend of many calibrations')


class NoTrendError(DataError):
    """A folder with too few calibrations to compare."""

    def __init__(self, folder: object, count: int) -> None:
        super().__init__(f'{folder} holds {count} readable calibration.yaml, and no two files of '
                         'the same verification or check: a trend needs two of a kind (one '
                         'calibration with --against)')
