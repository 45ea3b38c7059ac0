# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The file formats of a calibration, and the folder for its files."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, UTC
from pathlib import Path
import shutil

from handeye_ros.data import Calibration
from handeye_ros.errors import UnknownNameError, UnwritableError
from handeye_ros.output import write_whole
from handeye_ros.results import calibration_file, export_formats
from handeye_ros.results.export_formats import Format

YAML = 'yaml'
REPORT = 'report.html'
HISTORY = 'history'  # the folder of previous results, each in a folder named after its time

FORMATS = {
    YAML: Format('calibration.yaml: the complete answer; handeye reads it',
                 lambda _: calibration_file.NAME, calibration_file.text),
    'urdf': Format('a <joint> with <origin xyz rpy>, for a URDF or a xacro file',
                   lambda _: 'sensor.urdf.xacro', export_formats.urdf),
    'launch': Format('a launch file that starts static_transform_publisher',
                     lambda _: export_formats.LAUNCH_FILE, export_formats.launch),
    'easy_handeye2': Format('the .calib file of easy_handeye2', export_formats.easy_handeye2_file,
                            export_formats.easy_handeye2),
    'matrix': Format('the 4x4 matrix as text', lambda _: 'matrix.txt', export_formats.matrix),
    'json': Format('JSON', lambda _: 'calibration.json', export_formats.as_json),
    **export_formats.ROBOTS,
}


@dataclass(frozen=True)
class Saved:
    """The files written, and the folder with the previous ones; absolute paths."""

    files: tuple[Path, ...]
    previous: Path | None

    def __str__(self) -> str:
        """Return in words where the files are."""
        history = f'; the previous result is kept in {self.previous}' if self.previous else ''
        return f'wrote {", ".join(map(str, self.files))}{history}'


def format_of(name: str) -> Format:
    """Return the format of a name; raises UnknownNameError."""
    if name not in FORMATS:
        raise UnknownNameError('format', name, list(FORMATS))
    return FORMATS[name]


def save_all(calibration: Calibration, folder: Path, formats: Sequence[str] = (YAML,)) -> Saved:
    """
    Write a calibration into a folder in all given formats, always also calibration.yaml.

    The files of a previous result go to history/<its time> in the folder: nothing is lost, and
    all files in the folder are of one answer. Raises UnknownNameError and UnwritableError.
    """
    chosen = {name: format_of(name) for name in dict.fromkeys((YAML, *formats))}
    calibration = calibration_file.dated(calibration)
    texts = {form.file_name(calibration): form.text(calibration) for form in chosen.values()}
    folder = folder.expanduser().absolute()
    own_names = {form.file_name(calibration) for form in FORMATS.values()} | {REPORT}
    previous = set_aside(folder, sorted(own_names), set(texts))
    for name, text in texts.items():
        write_whole(folder / name, text)
    return Saved(tuple(folder / name for name in texts), previous)


def export(calibration: Calibration, name: str, file: Path) -> Saved:
    """
    Write a calibration in one format; an existing file with other content is kept aside.

    Raises UnknownNameError and UnwritableError.
    """
    file, text = file.expanduser().absolute(), format_of(name).text(calibration)
    unchanged = file.is_file() and file.read_bytes() == text.encode()
    previous = None if unchanged else set_aside(file.parent, [file.name], {file.name})
    write_whole(file, text)
    return Saved((file,), previous)


def set_aside(folder: Path, names: Sequence[str], replaced: set[str]) -> Path | None:
    """
    Move the files of a folder to its history; return the new folder, None without files.

    replaced: names of files that are written next: they stay until then, so that a reader always
    finds one. Raises UnwritableError.
    """
    files = [folder / name for name in names if (folder / name).is_file()]
    if not files:
        return None
    try:
        history = _new_folder(folder / HISTORY, max(file.stat().st_mtime for file in files))
        for file in files:
            shutil.copy2(file, history / file.name)
        for file in files:
            if file.name not in replaced:
                file.unlink()
    except OSError as error:
        raise UnwritableError(folder / HISTORY, error.strerror or str(error)) from error
    return history


def _new_folder(history: Path, time: float) -> Path:
    """Return a new folder named after a time (s since 1970), in UTC."""
    stamp = datetime.fromtimestamp(time, UTC).strftime('%Y-%m-%dT%H%M%SZ')
    count = 1
    while True:
        folder = history / (stamp if count == 1 else f'{stamp}-{count}')
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            count += 1
        else:
            return folder
