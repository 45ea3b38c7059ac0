# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Writes files whole or not at all, as text, YAML or CSV; names their folders and times."""
from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
import csv
from datetime import datetime, UTC
import io
import os
from pathlib import Path
from typing import Any

from handeye_ros.config import Config
from handeye_ros.errors import BadValueError, UnwritableError
import numpy as np
import yaml

EARLIEST_STAMP = 10 ** 18  # ns (2001): stamps before it are of no clock of the world


def folder_name(config: Config) -> str:
    """Return the name of the folder that a calibration is saved in; raises BadValueError."""
    name = config.calibration_name
    if name in ('', '.', '..') or '/' in name:
        raise BadValueError('name', name, 'the name of a folder, without "/"')
    return name


def iso_time(stamp: int) -> str:
    """Return the time of a stamp (ns) as ISO 8601, '' for one that is of no wall clock."""
    if stamp < EARLIEST_STAMP:
        return ''
    return datetime.fromtimestamp(stamp * 1e-9, UTC).isoformat(timespec='seconds')


def now_text() -> str:
    """Return the present time (UTC) as ISO 8601, to the second."""
    return datetime.now(UTC).isoformat(timespec='seconds')


def folder_time() -> str:
    """Return the present time (UTC) as the name of a folder; names are in the order of time."""
    return datetime.now(UTC).strftime('%Y-%m-%dT%H%M%S.%fZ')


def csv_text(header: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a table as CSV, its header first."""
    lines = io.StringIO()
    csv.writer(lines, lineterminator='\n').writerows([header, *rows])
    return lines.getvalue()


class _Dumper(getattr(yaml, 'CSafeDumper', yaml.SafeDumper)):  # type: ignore[misc]
    """Writes YAML with numpy values as plain ones, and without anchors for repeated values."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_array(dumper: Any, value: Any) -> Any:
    return dumper.represent_data(value.tolist())


_Dumper.add_multi_representer(np.generic, _represent_array)
_Dumper.add_multi_representer(np.ndarray, _represent_array)
# bytes of a path that are no UTF-8 are no Unicode, and become question marks
_Dumper.add_representer(str, lambda dumper, value: dumper.represent_str(
    value.encode(errors='replace').decode()))


def yaml_text(content: Mapping[str, Any]) -> str:
    """Return values as YAML, arrays as lists."""
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, width=100,
                         default_flow_style=None, allow_unicode=True))


def write_atomically(path: Path, text: str) -> None:
    """Write a file under another name and rename it; raises UnwritableError."""
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding='utf-8')


@contextmanager
def write_errors_for(path: object) -> Iterator[None]:
    """Raise UnwritableError, which names the path, for an OSError within the block."""
    try:
        yield
    except OSError as error:
        raise UnwritableError(path, error) from error


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """
    Give a temporary file that takes the place of a path when the block ends without an error.

    Raises UnwritableError, also for an OSError within the block.
    """
    temporary = path.parent / f'.{path.name}.{os.getpid()}.tmp'
    with write_errors_for(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield temporary
            os.replace(temporary, path)
        finally:
            with suppress(OSError):
                temporary.unlink()
