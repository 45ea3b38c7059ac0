"""Folders of sessions and results of a running node, and the continued session."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import islice
import os
from pathlib import Path
from typing import Any

from handeye_ros.bags.session_reading import LAST, read_session, sessions_in, Stored
from handeye_ros.config import Config, with_values
from handeye_ros.errors import UnwritableError
from handeye_ros.output import folder_name
from handeye_ros.sampling.stops import Outcome

FOLDER = 'handeye_ros'
SOURCE = "the node's parameters"


@dataclass(frozen=True)
class OutputFolders:
    """
    The folders of a node: <name> in output_dir, by default $ROS_HOME/handeye_ros/<namespace>.

    ROS_HOME is ~/.ros by default. Two nodes do not share a folder.
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
    Stores the events of a session; this class stores nothing, sessions/writing.py on the disk.

    All methods but sync return when the event is on the disk, or raise UnwritableError. joints:
    returns stamps and serialised joint values between two stamps; None without joint values.
    """

    joints: Callable[[int, int], Iterable[tuple[int, bytes]]] | None = None

    @property
    def path(self) -> str:
        """Return the folder of the session, empty before there is one."""
        return ''

    def add(self, outcome: Outcome, config: Config) -> Outcome:
        """Store the outcome of a stop; return it with the stop as stored."""
        return outcome

    def remove(self, number: int, config: Config) -> None:
        """Store that a sample was removed."""

    def configured(self, config: Config) -> None:
        """Store another configuration."""

    def sync(self) -> None:
        """Sync events that no service has to wait for."""

    def close(self) -> None:
        """Release the session for other nodes."""

    def restart(self, config: Config) -> str:
        """Begin another session; return a note about the previous one."""
        return ''


def resumed(overrides: Mapping[str, Any], folders: OutputFolders) -> tuple[Config, Stored | None]:
    """
    Return the settings, and the session to continue, None for a new one.

    given: settings of the user by key; all others are those of the session. Raises InputError.
    """
    config = with_values(Config(), overrides, SOURCE)
    path = _path(config, overrides, folders)
    if path is None:
        return config, None
    stored = read_session(path)
    return with_values(stored.config, overrides, SOURCE), stored


def _path(config: Config, overrides: Mapping[str, Any], folders: OutputFolders) -> Path | None:
    if not config.session:
        return None
    if config.session != LAST:
        return Path(config.session).expanduser().absolute()
    parent = folders.parent(config)
    if 'name' in overrides or 'target.type' in overrides:
        candidates = [folders.folder(config)]
    else:
        candidates = list(parent.iterdir()) if parent.is_dir() else []
    sessions = [path for folder in candidates for path in islice(sessions_in(folder), 1)]
    return max(sessions, key=lambda path: path.name, default=None)
