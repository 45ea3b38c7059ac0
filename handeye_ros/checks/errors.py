# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Refusals of an answer: motion, conventions, scale, scatter, moves."""
from __future__ import annotations

from handeye_ros.errors import DataError, degrees, mm, NamedCauseError


class TooFewSamplesError(DataError):
    """Fewer samples than the method needs."""

    def __init__(self, method: str, usable: int, needed: int, lost: int, reason: str) -> None:
        why = f' ({lost} stations gave none, most often: {reason})' if lost else ''
        super().__init__(f'{usable} usable samples{why}; {method} needs at least {needed}: '
                         'take more, with the laser across the target')


class TooFewConditionsError(DataError):
    """Samples that determine an answer but leave nothing to test it."""

    def __init__(self, used: int, dropped: int, redundant: int, needed: int) -> None:
        lost = f' ({dropped} of them contradict the others)' if dropped else ''
        super().__init__(f'{used + dropped} usable samples{lost} give only {redundant} redundant '
                         f'equations; at least {needed} are needed: take more samples at new '
                         'poses')


class UnidentifiedOutlierError(DataError):
    """Too few samples to identify a wrong one, or to tell it from an inaccurate robot."""

    def __init__(self, used: int, more: int) -> None:
        super().__init__(f'these {used} samples contradict each other: either the robot is less '
                         'accurate than noise.robot_smooth states, or at least one sample is '
                         'wrong (a pose wrong by about a millimetre, or another surface); so few '
                         f'samples cannot show which: take {more} more at new poses, or repeat '
                         'them all')


class TooFewEdgesError(DataError):
    """Samples of which too few show an edge of the target."""

    def __init__(self, method: str, edges: int, total: int, needed: int) -> None:
        super().__init__(f'only {edges} of the {total} usable samples show an edge of the target, '
                         f'and {method} needs {needed}: cross the edges with the laser, inside '
                         'the field of view, or calibrate from the plane alone '
                         '(target.type plane)')


class LostEdgesError(DataError):
    """Visible edges that do not belong to the target; lost: how many, and where."""

    def __init__(self, lost: str) -> None:
        super().__init__(f'{lost}; an answer that leaves out so many cannot be trusted: check '
                         'target.size, that the edges are straight and that the laser crosses no '
                         'other edges, or calibrate from the plane alone (target.type plane)')


class SensorFrameError(DataError):
    """The sensor frame has the name of a robot frame; key: the setting of that frame."""

    def __init__(self, frame: str, key: str) -> None:
        super().__init__(f'the profiles have the frame_id "{frame}", and {key} is the same frame, '
                         'so the result would be a transform from this frame to itself: set '
                         f'another frame_id in the driver of the sensor, or set {key}')


class OneOrientationError(NamedCauseError):
    """The robot never turned."""

    def __init__(self, turn: float) -> None:
        super().__init__(f'all poses share one orientation (within {turn * 57.3:.2f} degrees): '
                         'the position of the sensor cannot be separated from the position of '
                         'the target; tilt the tool by 15 degrees or more about two axes')


class OneAxisError(NamedCauseError):
    """The robot turned about one axis only."""

    def __init__(self, axis: str, turn: float, others: str, lost: str) -> None:
        super().__init__(f'all poses share one rotation axis ({axis}; they turn by '
                         f'{turn * 57.3:.1f} degrees RMS about it): {lost}; tilt the tool by '
                         f'15 degrees or more about {others}')


class TooUncertainError(NamedCauseError):
    """An answer with larger uncertainty than the limits."""

    @classmethod
    def translation(cls, direction: str, std: float, limit: float, missing: str
                    ) -> TooUncertainError:
        """Return the error for a translation, metres."""
        return cls(f'the position along {direction} is uncertain by {mm(std)} (1 sigma; '
                   f'limits.translation is {mm(limit)}): {missing}')

    @classmethod
    def rotation(cls, axis: str, std: float, limit: float, missing: str) -> TooUncertainError:
        """Return the error for a rotation, radians."""
        words = f'is uncertain by {degrees(std)} (1 sigma; ' if std < 1 else 'is not determined ('
        return cls(f'the rotation about {axis} {words}limits.rotation is {degrees(limit)}): '
                   f'{missing}')


class InconsistentError(DataError):
    """Residuals too large for any trusted answer."""

    def __init__(self, residual: float, limit: float) -> None:
        super().__init__(f'samples and poses contradict each other by {mm(residual)} RMS '
                         f'(limits.residual is {mm(limit)}), and no known convention error '
                         'explains it: check the poses (frames, convention, units), whether the '
                         'clocks of sensor and robot agree, target.type, profile.unit, '
                         'profile.axes and profile.range_sign')


class MovedError(DataError):
    """Target, sensor or tool frame changed in the middle of a recording."""

    @classmethod
    def sensor(cls, station: int, total: int, distance: float, turn: float, frame: str
               ) -> MovedError:
        """Return the error for a sensor that moved in a frame of the robot (metres, radians)."""
        return cls(f'{_parted(station, total)}: in between, the sensor moved in {frame} by '
                   f'{mm(distance)} and {degrees(turn)}, or {frame} became another frame (tool '
                   'or base of the robot switched); take all samples with the same')

    @classmethod
    def target(cls, station: int, total: int, frame: str) -> MovedError:
        """Return the error for a target that moved in a frame of the robot."""
        return cls(f'{_parted(station, total)}: in between, the target moved in {frame}, or '
                   f'{frame} became another frame (tool or base of the robot switched); fix the '
                   'target, and take all samples with the same')


class SmallMoveError(MovedError, NamedCauseError):
    """A small move that the samples show (metres, radians)."""

    def __init__(self, station: int, total: int, sensor: bool, frame: str, distance: float,
                 turn: float) -> None:
        what = 'sensor' if sensor else 'target'
        super().__init__(
            f'after the first {station} of {total} samples the {what} seems to have moved '
            f'in {frame} by about {mm(distance)} and {degrees(turn)}, or the tool or base '
            'of the robot was switched: check that it is fixed firmly, and take all '
            'samples again')


def _parted(station: int, total: int) -> str:
    return (f'the first {station} samples agree among themselves, and so do the other '
            f'{total - station}, but not with each other')


class ScatteredOrientationsError(DataError):
    """Orientations in all directions, from which no sensor can see its target."""

    def __init__(self, residual: float) -> None:
        super().__init__(f'samples and poses contradict each other by {mm(residual)} RMS, and '
                         'the orientations of the poses are scattered in all directions, as when '
                         'angles in degrees are read as radians: convert the angles of the poses')


class ScatterError(DataError):
    """Residuals far larger than the configured noise."""

    def __init__(self, residual: float, expected: float, limit: float) -> None:
        times = residual / expected
        beyond = f' (limits.scatter is {limit:g})' if times > limit else ''
        super().__init__(f'the residuals of {mm(residual)} RMS are {times:.1f} times what the '
                         f'configured noise explains{beyond}: there is another cause than noise; '
                         'check profile.range_sign, profile.axes and target.type, or raise '
                         'noise.* if the robot or the sensor really is that inaccurate')


class RangeSignError(NamedCauseError):
    """A wrong profile.range_sign, as the fit shows."""


class CalibrationTypeError(NamedCauseError):
    """A sensor mounted elsewhere than calibration_type states."""


class ConventionError(NamedCauseError):
    """A wrong pose convention that was recognised."""


class ScaleError(DataError):
    """Lengths of robot and sensor that differ."""

    def __init__(self, scale: float, std: float) -> None:
        super().__init__(f'the lengths of robot and sensor differ by {100 * scale:.2f} +- '
                         f'{100 * std:.2f} %: one of them has a wrong scale; measure a known '
                         'length with each, and correct the unit or the calibration of the wrong '
                         'one')


class LeftOutError(DataError):
    """Large residuals of stations left out of the fit."""

    def __init__(self, left_out: float, residual: float, limit: float) -> None:
        noisy = residual > 0.5 * left_out  # else the fit follows single samples
        why = ('the noise of sensor or robot is that large; take more samples, or raise '
               'limits.residual if this accuracy is enough' if noisy else
               'too few samples, or some are wrong; take more')
        super().__init__(f'samples differ by {mm(left_out)} RMS from what the others predict '
                         f'(limits.residual is {mm(limit)}), and by {mm(residual)} from the '
                         f'answer: {why}')


class ContradictingStationsError(DataError):
    """Too many stations do not fit the answer of the others."""

    def __init__(self, dropped: int, total: int) -> None:
        super().__init__(f'{dropped} of {total} stations contradict the others, so no answer can '
                         'be trusted: check that target and sensor are fixed and that the '
                         'laser crosses only the target')
