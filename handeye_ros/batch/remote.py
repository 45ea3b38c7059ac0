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
        system, path = url_to_fs(url)
        system.invalidate_cache()  # a worker that lives long keeps what it listed before
        yield system, path
    except Exception as error:  # each file system raises errors of its own
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
        state = system.info if 'http' in system.protocol else system.ukey  # ukey: of the URL alone
        return ' '.join(str(state(file)) for file in sorted(system.find(path)))


@contextmanager
def local_copy(source: str) -> Iterator[str]:
    """Give the path of a recording, copied to a temporary folder where it is remote."""
    if not is_remote(source):
        yield source
        return
    with tempfile.TemporaryDirectory(prefix='handeye_batch_') as folder:
        copy = Path(folder, PurePosixPath(source).name)
        below = files_below(source)
        with opened(source) as (system, path):
            for file in [''] if below is None else below:
                (copy / file).parent.mkdir(parents=True, exist_ok=True)
                system.get_file(f'{path}/{file}'.rstrip('/'), str(copy / file))
        yield str(copy)
