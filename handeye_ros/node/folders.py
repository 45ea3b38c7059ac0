# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The folders of a node: where it writes sessions and results, and which session it continues."""
from __future__ import annotations

from collections.abc import Mapping
from itertools import islice
import os
from pathlib import Path
from typing import Any

from handeye_ros.bags.session_files import (
    last_use,
    lock_folder,
    read_session,
    sessions_in,
    StoredSession,
)
from handeye_ros.config import Config, with_values
from handeye_ros.output import folder_name, write_errors_for

PARAMETER_SOURCE = "the node's parameters"


class OutputFolders:
    """
    The folders of a node: <name> in output_dir, by default $ROS_HOME/handeye_ros/<namespace>.

    ROS_HOME is ~/.ros by default.
    """

    def __init__(self, namespace: str = '/') -> None:
        """Lock no folder yet."""
        self._namespace = namespace
        self._locks: dict[Path, int] = {}

    def root(self, config: Config) -> Path:
        """Return the absolute path of the folder above the folders of names."""
        home = os.environ.get('ROS_HOME') or '~/.ros'
        root = config.output_dir or f'{home}/handeye_ros/{self._namespace.strip("/")}'
        return Path(os.path.expanduser(root)).absolute()

    def folder(self, config: Config) -> Path:
        """Return the absolute path of the folder of the name; raises BadValueError for it."""
        return self.root(config) / folder_name(config)

    def locked_folder(self, config: Config) -> Path:
        """Return the folder of the name, for results; raises InputError if another node has it."""
        folder = self.folder(config)
        if folder not in self._locks:
            with write_errors_for(folder):
                folder.mkdir(parents=True, exist_ok=True)
                self._locks[folder] = lock_folder(
                    folder, f'another running node saves its results in {folder}: set name or '
                    'output_dir of this one, so that neither replaces those of the other')
        return folder


def settings_and_session(overrides: Mapping[str, Any], folders: OutputFolders
                         ) -> tuple[Config, StoredSession | None]:
    """
    Return the settings, and the session to continue, None for a new one.

    overrides: the settings that the user gives, by key; all others are those of the session.
    Raises InputError for settings that cannot be used, and for a session that cannot be read.
    """
    config = with_values(Config(), overrides, PARAMETER_SOURCE)
    path = Path(config.session).expanduser().absolute() if config.session else None
    if config.session == 'last':
        is_named = 'name' in overrides or 'target.type' in overrides
        of_names = [folders.folder(config)] if is_named else folders.root(config).glob('*')
        newest = [session for folder in of_names for session in islice(sessions_in(folder), 1)]
        path = max(newest, key=last_use, default=None)
    if path is None:
        return config, None
    stored = read_session(path)
    return with_values(stored.config, overrides, PARAMETER_SOURCE), stored
