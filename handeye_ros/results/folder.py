"""
Folders of recordings and measured values, written whole or not at all.

Everything is made in a hidden folder beside the final one and renamed when it is whole.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
import shutil
import tempfile

from handeye_ros.errors import BagError, UnwritableError

OURS = ('metadata.yaml', 'truth.yaml')  # what shows that a folder may be replaced


def write(path: Path, texts: Mapping[str, str], fill: Callable[[Path], None] = Path.mkdir,
          force: bool = False) -> None:
    """
    Write a folder.

    fill: makes the folder and what is in it, but for the texts by the name of their file. force:
    a recording that is there is replaced. Raises BagError when there is something at path
    already, or it is the current folder; UnwritableError when it cannot be made.
    """
    path = path.resolve()
    try:
        _check_free(path, force)
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix='.', suffix='.tmp', dir=path.parent) as folder:
            made = Path(folder) / path.name
            fill(made)
            for name, text in texts.items():
                (made / name).write_text(text, encoding='utf-8')
            _move(made, path, Path(folder) / 'replaced')
    except OSError as error:
        raise UnwritableError(path, error.strerror or str(error)) from error


def _check_free(path: Path, force: bool) -> None:
    free = not path.exists() or path.is_dir() and not any(path.iterdir())
    if not (free or force):
        raise BagError(path, 'is there already: choose another place, or replace it with --force')
    if path == Path.cwd():  # whoever stands in it would stand nowhere
        raise BagError(path, 'is the current folder, which is not replaced: name one in it')
    if not (free or any((path / name).is_file() for name in OURS)):
        raise BagError(path, 'is there already and is no bag, so it is not replaced: choose '
                             'another place')


def _move(made: Path, path: Path, aside: Path) -> None:
    """Put what was made in place; what was there before goes away with the aside folder."""
    if path.exists():
        shutil.move(path, aside)
    made.rename(path)
