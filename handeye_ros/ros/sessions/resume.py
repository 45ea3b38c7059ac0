"""Which session a node goes on with, and with which settings."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from handeye_ros.config import Config, with_values
from handeye_ros.ros.sessions.reading import LAST, last_session, read_session, Stored
from handeye_ros.ros.sessions.store import Place

SOURCE = "the node's parameters"


def resumed(given: Mapping[str, Any], place: Place) -> tuple[Config, Stored | None]:
    """
    Return the settings, and the session to go on with, None for a new one.

    given: what the user set, by key; all else is as it was in the session. Raises InputError.
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
    if 'name' in given or 'target.type' in given:
        return last_session(place.folder(config))
    parent = place.parent(config)
    folders = [path for path in parent.iterdir() if path.is_dir()] if parent.is_dir() else []
    sessions = [session for folder in folders if (session := last_session(folder))]
    return max(sessions, key=lambda session: session.name, default=None)
