"""Unusable bags, topics and messages, and nodes that do not respond."""
from __future__ import annotations

from pathlib import Path
import signal

from handeye_ros.errors import DataError, HandeyeError, InputError


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
