"""
Everything that can go wrong for a user's reason; each error builds its own message.

A message says what is wrong, why it matters or how it was seen, and what to do. The exit
code is that of the command line: 2 for wrong usage or unreadable input, 3 for data that
cannot carry an answer.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
import difflib
from typing import Any


class HandeyeError(Exception):
    """The parent of every error of this package that a user can act on."""

    exit_code = 2

    def __reduce__(self) -> tuple[Any, ...]:
        """Let it be copied and pickled: the children are not made from their message."""
        return _restored, (type(self), str(self))


def _restored(kind: type[HandeyeError], message: str) -> HandeyeError:
    error = kind.__new__(kind)
    error.args = (message,)
    return error


class InputError(HandeyeError):
    """Wrong usage, or input that cannot be read (exit code 2)."""

    exit_code = 2


class DataError(HandeyeError):
    """Readable input that cannot carry an answer (exit code 3)."""

    exit_code = 3


def nearest(word: str, known: Sequence[str]) -> str:
    """Return a hint at the known word nearest to word, or an empty string."""
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f'; did you mean "{close[0]}"?' if close else ''


class UnknownKeyError(InputError):
    """A configuration key that does not exist."""

    def __init__(self, key: str, known: Sequence[str], source: str) -> None:
        super().__init__(f'unknown key "{key}" in {source}{nearest(key, known)}')


class BadValueError(InputError):
    """A configuration value of the wrong type or out of its range."""

    def __init__(self, key: str, value: object, expected: str) -> None:
        super().__init__(f'{key} is {value!r}, expected {expected}')


class OnlyFromFilesError(InputError):
    """A target that no profiles of stations are taken of."""

    def __init__(self, target: str) -> None:
        super().__init__(f'target.type {target} is solved from files, not from a stream of '
                         'profiles: run "handeye solve INPUT --config FILE"')


class TwoFramesError(InputError):
    """Messages of two frames on one topic."""

    def __init__(self, kind: str, first: str, second: str) -> None:
        cannot, advice = {
            'profile': ('of one sensor', 'give each sensor its own topic'),
            'pose': ('in one robot base', 'let only one node publish them, in one frame'),
        }[kind]
        super().__init__(f'the {kind} topic carries two frames, "{first}" and "{second}": the '
                         f'{kind}s cannot be {cannot}; {advice}')


class NoPosesError(DataError):
    """No pose of the flange was received; topic: None if they come from transforms."""

    def __init__(self, topic: str | None) -> None:
        super().__init__(
            'no flange pose was received from /tf: start the robot driver, or set '
            'robot_base_frame and robot_effector_frame' if topic is None else
            f'no flange pose was received on {topic}: start the robot driver, or set pose_topic')


class MovingError(DataError):
    """A sample was asked for while the robot moved."""

    def __init__(self, still_time: float) -> None:
        super().__init__(f'the robot has not stood still for {still_time:g} s: stop it, wait, '
                         'and take the sample again')


class NoProfilesError(DataError):
    """No profile came while the robot stood still."""

    def __init__(self, duration: float) -> None:
        super().__init__(f'no profile came while the robot stood still here for {duration:.1f} '
                         's: check the sensor, and that both clocks agree')


class NothingToRemoveError(DataError):
    """There is no sample to remove."""

    def __init__(self) -> None:
        super().__init__('there is no sample to remove')


class FeatureError(DataError):
    """A profile does not show what the method needs; the message says what is missing."""


class MessageError(InputError):
    """A message that cannot be understood; kind: its type, without the package."""

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(f'{kind} message not used: {reason}')


class TooFewError(DataError):
    """A published algorithm was given less than it can work from."""

    def __init__(self, method: str, minimum: int, what: str, count: int) -> None:
        super().__init__(f'{method} needs at least {minimum} {what}, got {count}')


class SingularError(DataError):
    """A published algorithm divides by what the data make zero."""

    def __init__(self, method: str, reason: str) -> None:
        super().__init__(f'{method} cannot be solved: {reason}')


class NoStationsError(DataError):
    """The robot never stood still."""

    def __init__(self, poses: int, still_time: float) -> None:
        super().__init__(f'the robot never stood still for {still_time:g} s in {poses} poses: '
                         'stop at each sample, or lower sampling.still_time; if its poses are '
                         'noisy, raise sampling.still_translation and sampling.still_rotation')


class SparsePosesError(DataError):
    """Poses too far apart to tell when the robot stood still."""

    def __init__(self, period: float, limit: float) -> None:
        super().__init__(f'the flange poses come only every {period:.2g} s, further apart than '
                         f'sampling.max_pose_gap ({limit:g} s): publish them more often, also '
                         'while the robot stands still, or raise sampling.max_pose_gap')


class PositionUnitError(DataError):
    """Positions too large for metres."""

    def __init__(self, largest: float) -> None:
        super().__init__(f'the flange positions reach {largest:.0f} m: they seem to be in mm; '
                         'publish them in metres')


class TooFewSamplesError(DataError):
    """Fewer samples than the method needs."""

    def __init__(self, method: str, usable: int, needed: int, lost: int, reason: str) -> None:
        why = f' ({lost} stations gave none, most often: {reason})' if lost else ''
        super().__init__(f'{usable} usable samples{why}; {method} needs at least {needed}: '
                         'take more, with the laser across the target')


class OneOrientationError(DataError):
    """The robot never turned."""

    def __init__(self, turn: float) -> None:
        super().__init__(f'all poses share one orientation (within {turn * 57.3:.2f} degrees): '
                         'the translation of the sensor cannot be told from the place of the '
                         'target; tilt the tool by 15 degrees or more about two axes')


class OneAxisError(DataError):
    """The robot turned about one axis only."""

    def __init__(self, axis: str, turn: float, others: str, lost: str) -> None:
        super().__init__(f'all poses share one rotation axis ({axis}; they turn by '
                         f'{turn * 57.3:.1f} degrees RMS about it): {lost}; tilt the tool by '
                         f'15 degrees or more about {others}')


class TooUncertainError(DataError):
    """An answer that is less certain than the limits allow."""

    @classmethod
    def translation(cls, direction: str, std: float, limit: float, missing: str
                    ) -> TooUncertainError:
        """Return the error for a translation, metres."""
        return cls(f'the position along {direction} is known only to {_mm(std)} (1 sigma; '
                   f'limits.translation is {_mm(limit)}): {missing}')

    @classmethod
    def rotation(cls, axis: str, std: float, limit: float, missing: str) -> TooUncertainError:
        """Return the error for a rotation, radians."""
        return cls(f'the rotation about {axis} is known only to {_degrees(std)} (1 sigma; '
                   f'limits.rotation is {_degrees(limit)}): {missing}')


def missing_turn(axes: str, turn: float) -> str:
    """Return what to do about poses that turn too little about some axes, by turn RMS (rad)."""
    return (f'the poses turn only by {_degrees(turn)} RMS about {axes}; tilt the tool by 15 '
            'degrees or more, to both sides, about it')


def missing_spread() -> str:
    """Return what to do about poses that turn enough."""
    return ('take more samples, with the target all over the field of view (near, far, left, '
            'right), at different tilts each')


def _mm(metres: float) -> str:
    return f'{metres * 1e3:.3g} mm' if metres < 1 else 'more than a metre'


def _degrees(radians: float) -> str:
    return f'{radians * 57.29578:.3g} degrees' if radians < 1 else 'nothing at all'


class InconsistentError(DataError):
    """Residuals too large for any trusted answer."""

    def __init__(self, residual: float, limit: float) -> None:
        super().__init__(f'samples and poses contradict each other by {_mm(residual)} RMS '
                         f'(limits.residual is {_mm(limit)}), and no usual slip explains it: '
                         'check the poses (frames, convention, units), target.type and '
                         'profile.unit, profile.axes, profile.range_sign')


class MovedError(DataError):
    """Target, sensor or tool frame changed in the middle of a recording."""

    @classmethod
    def sensor(cls, station: int, total: int, distance: float, turn: float, frame: str
               ) -> MovedError:
        """Return the error for a sensor that moved in a frame of the robot (metres, radians)."""
        return cls(f'{_parted(station, total)}: in between, the sensor moved in {frame} by '
                   f'{_mm(distance)} and {_degrees(turn)}, or {frame} became another frame (tool '
                   'or base of the robot switched); take all samples with the same')

    @classmethod
    def target(cls, station: int, total: int, frame: str) -> MovedError:
        """Return the error for a target that moved in a frame of the robot."""
        return cls(f'{_parted(station, total)}: in between, the target moved in {frame}, or '
                   f'{frame} became another frame (tool or base of the robot switched); fix the '
                   'target, and take all samples with the same')


def _parted(station: int, total: int) -> str:
    return (f'the first {station} samples agree among themselves, and so do the other '
            f'{total - station}, but not with each other')


class ScatteredOrientationsError(DataError):
    """Orientations that no tool takes that keeps a target in sight."""

    def __init__(self, residual: float) -> None:
        super().__init__(f'samples and poses contradict each other by {_mm(residual)} RMS, and '
                         'the orientations of the poses point all over, as they do when angles '
                         'in degrees are taken for radians: convert the angles of the poses')


class ScatterError(DataError):
    """Residuals far larger than the configured noise."""

    def __init__(self, residual: float, expected: float, limit: float) -> None:
        times = residual / expected
        beyond = f' (limits.scatter is {limit:g})' if times > limit else ', far beyond chance'
        super().__init__(f'the residuals of {_mm(residual)} RMS are {times:.1f} times what the '
                         f'configured noise makes{beyond}: something other than noise is in '
                         'them; check profile.range_sign, '
                         'profile.axes and target.type, or raise noise.* if the robot or the '
                         'sensor really is that inaccurate')


class RangeSignError(DataError):
    """A range counted the wrong way."""

    def __init__(self, sign: int, before: float, after: float) -> None:
        super().__init__(f'the samples do not fit, but with profile.range_sign {sign} the '
                         f'residual falls from {_mm(before)} to {_mm(after)}: set it so')


class ScaleError(DataError):
    """Lengths of robot and sensor that differ."""

    def __init__(self, scale: float, std: float) -> None:
        super().__init__(f'the lengths of robot and sensor differ by {100 * scale:.2f} +- '
                         f'{100 * std:.2f} %: one of them is scaled wrongly; measure a known '
                         'length with each, and mend its unit or its calibration')


class LeftOutError(DataError):
    """Stations that the others do not predict."""

    def __init__(self, left_out: float, limit: float) -> None:
        super().__init__(f'samples miss by {_mm(left_out)} RMS what the others predict '
                         f'(limits.residual is {_mm(limit)}): too few samples, or some are '
                         'wrong; take more')


class SlipError(DataError):
    """A wrong pose convention that was recognised."""

    def __init__(self, slip: str, before: float, after: float, advice: str) -> None:
        super().__init__(f'the poses do not fit, but with {slip} the residual falls from '
                         f'{_mm(before)} to {_mm(after)}: {advice}')


class ContradictingStationsError(DataError):
    """Too many stations do not fit the answer of the others."""

    def __init__(self, dropped: int, total: int) -> None:
        super().__init__(f'{dropped} of {total} stations contradict the others: no answer can '
                         'be trusted; check that target and sensor are fixed and that the '
                         'laser crosses only the target')


class NoGuessError(DataError):
    """No estimate could be started."""

    def __init__(self, why: str) -> None:
        super().__init__(f'no estimate can be started: {why}')


class BagError(InputError):
    """A recording that cannot be read, or not written; path: the bag."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path}: {reason}')


class NoTopicError(InputError):
    """A topic that the bag lacks; topics: what is there, with the types; wanted: of this type."""

    def __init__(self, path: object, key: str, topic: str, wanted: str,
                 topics: Mapping[str, str]) -> None:
        super().__init__(f'{path} has no topic {topic}. {_what_is_there(key, wanted, topics)}')


class TopicTypeError(InputError):
    """A topic of another type than the expected one; topics: all of the bag, with the types."""

    def __init__(self, key: str, topic: str, wanted: str, topics: Mapping[str, str]) -> None:
        super().__init__(f'{topic} carries {topics[topic]}, but only {wanted} can be read there. '
                         + _what_is_there(key, wanted, topics))


def _what_is_there(key: str, wanted: str, topics: Mapping[str, str]) -> str:
    """Return the topics of a bag, those of the wanted type first, and what to set."""
    there = sorted(topics.items(), key=lambda item: (item[1] != wanted, item[0]))
    names = [f'{name} ({kind})' for name, kind in there[:12]]
    more = [f'{len(there) - 12} more'] if len(there) > 12 else []
    fitting = [name for name, kind in there if kind == wanted]
    transforms = key == 'pose_topic' and topics.get('/tf') == 'tf2_msgs/msg/TFMessage'
    if key == 'pose_source':  # there is only one place for transforms
        advice = '; record /tf, or set pose_source to topic'
    elif fitting:
        advice = f': set {key}, as in --set {key}={fitting[0]}'
    elif transforms:
        advice = ': take the poses from /tf, as in --set pose_source=tf'
    else:
        advice = f'; none of them is a {wanted}: publish and record one'
    return f'It holds {", ".join(names + more)}{advice}'


class AllMalformedError(InputError):
    """Most messages of a topic cannot be used."""

    def __init__(self, topic: str, count: int, total: int, first: str) -> None:
        some = 'none' if count == total else f'only {total - count}'
        super().__init__(f'{some} of the {total} messages on {topic} can be used; the first '
                         f'reason: {first}')


class TimeBackwardsError(DataError):
    """Stamps that start again: two runs in one recording."""

    def __init__(self, topic: str, index: int, jump: float) -> None:
        super().__init__(f'the stamps on {topic} jump back by {jump:.1f} s at message '
                         f'{index + 1}: two runs seem to be mixed (a bag recorded in a loop?); '
                         'record one run')


class ClocksApartError(DataError):
    """Profiles and poses that share no time."""

    def __init__(self, gap: float) -> None:
        super().__init__(f'profiles and poses share no time: {gap:.1f} s lie between them; the '
                         'clocks of sensor and robot differ, or they were not recorded together')


class CalibrationFileError(InputError):
    """A calibration file that cannot be read."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path} cannot be used: {reason}')


class UnwritableError(InputError):
    """A file or folder that cannot be written."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'cannot write {path}: {reason}; choose another place')


class NothingToSaveError(DataError):
    """The node is asked to save before there is an answer."""

    def __init__(self) -> None:
        super().__init__('there is no calibration to save: call ~/compute_calibration first, and '
                         'see that it succeeds')


class ClearedError(DataError):
    """The samples were cleared while they were solved."""

    def __init__(self) -> None:
        super().__init__('the samples were cleared while the calibration was computed, so there '
                         'is none: take new samples')


class UnknownNameError(InputError):
    """A name that is not among the known ones; kind: what it should name."""

    def __init__(self, kind: str, name: str, known: Sequence[str]) -> None:
        super().__init__(f'there is no {kind} "{name}"{nearest(name, known)}; the known ones: '
                         f'{", ".join(known)}')


class NoRosError(InputError):
    """Something that needs ROS, without ROS."""

    def __init__(self, verb: str, module: str) -> None:
        super().__init__(f'{verb} needs ROS 2, and the Python module {module} is not there: '
                         'source the setup.bash of ROS, or install handeye_ros[ros] with pip')


class NodeError(InputError):
    """The node ended, or says nothing any more."""

    def __init__(self, last_words: str) -> None:
        super().__init__(f'the node does not answer; the end of its log: {last_words}')


class RefusedError(DataError):
    """A service of the node that did not succeed."""

    def __init__(self, service: str, reason: str) -> None:
        super().__init__(f'~/{service} was refused: {reason}')


class TableError(InputError):
    """A file of measured values that cannot be read."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path}: {reason}')


class DegenerateError(DataError):
    """Measured values that leave something open, or contradict each other."""

    def __init__(self, method: str, reason: str, advice: str) -> None:
        super().__init__(f'{method} cannot be solved: {reason}; {advice}')


class TopicsError(InputError):
    """Topics that a node cannot subscribe to or publish on."""

    def __init__(self, reason: str) -> None:
        super().__init__(f'the node cannot use its topics ({" ".join(reason.split())[:120]}): '
                         'check pose_topic and profile_topic; each needs its own')
