"""Unusable bags, topics and messages, and nodes that do not respond."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
import signal

from handeye_ros.errors import DataError, HandeyeError, InputError, UnusableMessageError


class MessageError(UnusableMessageError):
    """An invalid message; kind: its type, without the package."""

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(f'{kind} message not used: {reason}')


class NoTopicError(InputError):
    """A topic of a type missing in the bag; topics: those present, with types."""

    def __init__(self, path: object, key: str, topic: str, message_type: str,
                 topics: Mapping[str, str]) -> None:
        super().__init__(f'{path} has no topic {topic}. '
                         + _topics_of_bag(key, message_type, topics))


class TopicTypeError(InputError):
    """A topic with an unexpected type; topics: all of the bag, with their types."""

    def __init__(self, key: str, topic: str, message_type: str, topics: Mapping[str, str]) -> None:
        super().__init__(f'{topic} carries {topics[topic]}, but only {message_type} can be read '
                         'there. ' + _topics_of_bag(key, message_type, topics))


def _topics_of_bag(key: str, message_type: str, topics: Mapping[str, str]) -> str:
    """Return the topics of a bag, those of the type first, and the setting to change."""
    ordered = sorted(topics.items(), key=lambda item: (item[1] != message_type, item[0]))
    names = [f'{name} ({kind})' for name, kind in ordered[:12]]
    omitted = [f'{len(ordered) - 12} more'] if len(ordered) > 12 else []
    fitting = [name for name, kind in ordered if kind == message_type]
    transforms = key == 'pose_topic' and topics.get('/tf') == 'tf2_msgs/msg/TFMessage'
    if key == 'pose_source':  # there is only one place for transforms
        advice = '; record /tf, or set pose_source to topic'
    elif fitting:
        advice = f': set {key}, as in --set {key}={fitting[0]}'
    elif transforms:
        advice = ': take the poses from /tf, as in --set pose_source=tf'
    else:
        advice = f'; none of them is a {message_type}: publish and record one'
    return f'It holds {", ".join(names + omitted)}{advice}'


class AllMalformedError(InputError):
    """Most messages of a topic are invalid."""

    def __init__(self, topic: str, count: int, total: int, first: str) -> None:
        usable = 'none' if count == total else f'only {total - count}'
        super().__init__(f'{usable} of the {total} messages on {topic} can be used; the first '
                         f'reason: {first}')


class NodeError(InputError):
    """The node ended, or does not respond any more."""

    def __init__(self, last_words: str) -> None:
        super().__init__(f'the node does not answer; the end of its log: {last_words}')


class RefusedError(DataError):
    """A service of the node that failed."""

    def __init__(self, service: str, reason: str) -> None:
        super().__init__(f'~/{service} was refused: {reason}')


class TopicsError(InputError):
    """Topics that a node cannot subscribe to or publish on."""

    def __init__(self, reason: str) -> None:
        super().__init__(f'the node cannot use its topics ({" ".join(reason.split())[:120]}): '
                         'check pose_topic and profile_topic; each needs its own')


class SameFrameError(InputError):
    """Two calibrations of one sensor cannot be published at once."""

    def __init__(self, path: object, frame: str) -> None:
        super().__init__(f'{path} is not published: another of the files gives the pose of '
                         f'{frame}, and a frame has one parent; name each sensor once')


class UnpublishedError(InputError):
    """Some of the calibrations to be published are unusable."""

    def __init__(self, failed: int, total: int) -> None:
        super().__init__(f'{failed} of {total} calibrations not published: see above, and name '
                         'files that handeye solve or ~/save_calibration wrote')


class SessionError(InputError):
    """A folder that is not a session, or one that cannot be continued."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path} {reason}')


class WorkerEndedError(HandeyeError):
    """The process that computes ended before it had an answer."""

    def __init__(self, code: int) -> None:
        if code == -signal.SIGSTOP:
            cause = 'was suspended (SIGSTOP), and has been ended,'
        else:
            cause = f'ended by signal {-code}' if code < 0 else f'ended with code {code}'
        super().__init__(f'the process that computes {cause} before it had an answer'
                         + (' (out of memory?)' if code == -signal.SIGKILL else '')
                         + ': call the service again; this restarts the process')


class PageError(InputError):
    """The page cannot be served; the node continues without it."""

    @classmethod
    def address(cls, address: str) -> PageError:
        """Return the error for an invalid address."""
        return cls(f'page.address is "{address}", expected an IP address such as 127.0.0.1 or '
                   '0.0.0.0: there is no page')

    @classmethod
    def token(cls, file: Path | None, reason: str) -> PageError:
        """Return the error for a token that cannot be stored."""
        return cls(f'there is no page: its token cannot be written to {file} ({reason}); set '
                   'output_dir to a folder that can be written')

    @classmethod
    def port(cls, address: str, port: int, reason: str) -> PageError:
        """Return the error for a port that is not available."""
        return cls(f'there is no page: {address}:{port} cannot be served ({reason}); set '
                   'page.port to another one, or to 0 for no page')


class NothingToSaveError(DataError):
    """The node was requested to save before there is an answer."""

    def __init__(self) -> None:
        super().__init__('there is no calibration to save: call ~/compute_calibration first, and '
                         'check that it succeeds')
