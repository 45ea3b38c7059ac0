"""Where a running node keeps sessions and results, and which session it goes on with."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import islice
import os
from pathlib import Path
from typing import Any

from handeye_ros.config import Config, with_values
from handeye_ros.errors import UnwritableError
from handeye_ros.output import folder_name
from handeye_ros.ros.sessions.reading import LAST, read_session, sessions_in, Stored
from handeye_ros.sampling.stops import Outcome

FOLDER = 'handeye_ros'
SOURCE = "the node's parameters"


@dataclass(frozen=True)
class Place:
    """
    Where a node keeps its folder <name>.

    In output_dir where that is set, else in $ROS_HOME/handeye_ros/<namespace> (ROS_HOME is ~/.ros
    where it is not set). Two nodes do not share a folder.
    """

    namespace: str = '/'

    def parent(self, config: Config) -> Path:
        """Return the folder above the folders of names, absolute; raises UnwritableError."""
        home = os.environ.get('ROS_HOME') or '~/.ros'
        parent = Path(config.output_dir) if config.output_dir else (
            Path(home) / FOLDER / self.namespace.strip('/'))
        try:
            return parent.expanduser().absolute()
        except RuntimeError as error:
            raise UnwritableError(parent, str(error)) from error

    def folder(self, config: Config) -> Path:
        """Return the folder of the name, absolute; raises UnwritableError and BadValueError."""
        return self.parent(config) / folder_name(config)


class Store:
    """
    Keeps the events of a session: this class nowhere, that of sessions/writing.py on the disk.

    All methods but sync return when the event is on the disk, or raise UnwritableError. joints:
    returns stamps and serialised joint values between two stamps; None without joint values.
    """

    joints: Callable[[int, int], Iterable[tuple[int, bytes]]] | None = None

    @property
    def path(self) -> str:
        """Return the folder of the session, empty before there is one."""
        return ''

    def add(self, outcome: Outcome, config: Config) -> Outcome:
        """Keep the outcome of a stop; return it with the stop as stored."""
        return outcome

    def remove(self, number: int, config: Config) -> None:
        """Keep that a sample was removed."""

    def configured(self, config: Config) -> None:
        """Keep another configuration."""

    def sync(self) -> None:
        """Sync what no answer has to wait for."""

    def close(self) -> None:
        """Release the session for other nodes."""

    def restart(self, config: Config) -> str:
        """Begin another session; return what to say of the one before."""
        return ''


def resumed(given: Mapping[str, Any], place: Place) -> tuple[Config, Stored | None]:
    """
    Return the settings, and the session to go on with, None for a new one.

    given: what the user set, by key; all other settings are those of the session. Raises
    InputError.
    """
    config = with_values(Config(), given, SOURCE)
    path = _path(config, given, place)
    if path is None:
        return config, None
    stored = read_session(path)
    return with_values(stored.config, given, SOURCE), stored


def _path(config: Config, given: Mapping[str, Any], place: Place) -> Path | None:
    if not config.session:
        return None
    if config.session != LAST:
        return Path(config.session).expanduser().absolute()
    parent = place.parent(config)
    if 'name' in given or 'target.type' in given:
        folders = [place.folder(config)]
    else:
        folders = list(parent.iterdir()) if parent.is_dir() else []
    sessions = [path for folder in folders for path in islice(sessions_in(folder), 1)]
    return max(sessions, key=lambda path: path.name, default=None)
