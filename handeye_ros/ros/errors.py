"""What of bags, topics and messages cannot be used, and nodes that do not answer."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
import signal

from handeye_ros.errors import DataError, HandeyeError, InputError, UnusableMessageError


class MessageError(UnusableMessageError):
    """A message that cannot be understood; kind: its type, without the package."""

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(f'{kind} message not used: {reason}')


class NoTopicError(InputError):
    """A topic that the bag lacks; topics: what is there, with the types; wanted: of this type."""

    def __init__(self, path: object, key: str, topic: str, wanted: str,
                 topics: Mapping[str, str]) -> None:
        super().__init__(f'{path} has no topic {topic}. {_topics_of_bag(key, wanted, topics)}')


class TopicTypeError(InputError):
    """A topic of another type than the expected one; topics: all of the bag, with the types."""

    def __init__(self, key: str, topic: str, wanted: str, topics: Mapping[str, str]) -> None:
        super().__init__(f'{topic} carries {topics[topic]}, but only {wanted} can be read there. '
                         + _topics_of_bag(key, wanted, topics))


def _topics_of_bag(key: str, wanted: str, topics: Mapping[str, str]) -> str:
    """Return the topics of a bag, those of the wanted type first, and what to set."""
    ordered = sorted(topics.items(), key=lambda item: (item[1] != wanted, item[0]))
    names = [f'{name} ({kind})' for name, kind in ordered[:12]]
    more = [f'{len(ordered) - 12} more'] if len(ordered) > 12 else []
    fitting = [name for name, kind in ordered if kind == wanted]
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


class NodeError(InputError):
    """The node ended, or says nothing any more."""

    def __init__(self, last_words: str) -> None:
        super().__init__(f'the node does not answer; the end of its log: {last_words}')


class RefusedError(DataError):
    """A service of the node that did not succeed."""

    def __init__(self, service: str, reason: str) -> None:
        super().__init__(f'~/{service} was refused: {reason}')


class TopicsError(InputError):
    """Topics that a node cannot subscribe to or publish on."""

    def __init__(self, reason: str) -> None:
        super().__init__(f'the node cannot use its topics ({" ".join(reason.split())[:120]}): '
                         'check pose_topic and profile_topic; each needs its own')


class SameFrameError(InputError):
    """Two calibrations of one sensor are to be published at once."""

    def __init__(self, path: object, frame: str) -> None:
        super().__init__(f'{path} is not published: another of the files gives the pose of '
                         f'{frame}, and a frame has one parent; name each sensor once')


class UnpublishedError(InputError):
    """Some of the calibrations to be published could not be used."""

    def __init__(self, failed: int, total: int) -> None:
        super().__init__(f'{failed} of {total} calibrations not published: see above, and name '
                         'files that handeye solve or ~/save_calibration wrote')


class SessionError(InputError):
    """A folder that is no session, or one that cannot be gone on with."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__(f'{path} {reason}')


class WorkerEndedError(HandeyeError):
    """The process that computes ended before it had an answer."""

    def __init__(self, code: int) -> None:
        if code == -signal.SIGSTOP:
            why = 'was suspended (SIGSTOP), and has been ended,'
        else:
            why = f'ended by signal {-code}' if code < 0 else f'ended with code {code}'
        super().__init__(f'the process that computes {why} before it had an answer'
                         + (' (out of memory?)' if code == -signal.SIGKILL else '')
                         + ': ask again; this starts it again')


class PageError(InputError):
    """The page for a browser cannot be served; the node goes on without it."""

    @classmethod
    def address(cls, address: str) -> PageError:
        """Return the error for an address that is none."""
        return cls(f'page.address is "{address}", expected an IP address such as 127.0.0.1 or '
                   '0.0.0.0: there is no page')

    @classmethod
    def token(cls, file: Path | None, why: str) -> PageError:
        """Return the error for a token that cannot be kept."""
        return cls(f'there is no page: its token cannot be written to {file} ({why}); set '
                   'output_dir to a folder that can be written')

    @classmethod
    def port(cls, address: str, port: int, why: str) -> PageError:
        """Return the error for a port that cannot be had."""
        return cls(f'there is no page: {address}:{port} cannot be served ({why}); set page.port '
                   'to another one, or to 0 for no page')
