"""Recordings that lie where only fsspec reaches them, such as s3://bucket/night/cell.mcap."""
from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
import tempfile
from typing import Any

from handeye_ros.batch.errors import NoDaskError, RemoteError


def is_remote(source: str) -> bool:
    """Return whether a source is a URL."""
    return '://' in source


@contextmanager
def opened(url: str) -> Iterator[tuple[Any, str]]:
    """Give the file system of a URL and the path on it; raises NoDaskError, RemoteError."""
    try:
        from fsspec.core import url_to_fs
    except ImportError as error:
        raise NoDaskError('fsspec') from error
    try:
        yield url_to_fs(url)
    except (OSError, ValueError, ImportError) as error:
        raise RemoteError(url, f'{type(error).__name__}: {error}') from error


def files_below(source: str) -> list[str] | None:
    """Return the files below a folder, relative to it; None of what is no folder."""
    if not is_remote(source):
        folder = Path(source)
        return [file.relative_to(folder).as_posix() for file in folder.rglob('*')
                ] if folder.is_dir() else None
    with opened(source) as (system, path):
        if not system.isdir(path):
            return None
        return [file[len(path):].lstrip('/') for file in system.find(path)]


def fingerprint(url: str) -> str:
    """Return what changes when a remote recording does, by its file system, without reading it."""
    with opened(url) as (system, path):
        return ' '.join(system.ukey(file) for file in sorted(system.find(path)))


@contextmanager
def local_copy(source: str) -> Iterator[str]:
    """Give the path of a recording, copied to a temporary folder where it is remote."""
    if not is_remote(source):
        yield source
        return
    with tempfile.TemporaryDirectory(prefix='handeye_batch_') as folder:
        with opened(source) as (system, path):
            copy = Path(folder, PurePosixPath(path).name)
            system.get(path, str(copy), recursive=system.isdir(path))
        yield str(copy)
