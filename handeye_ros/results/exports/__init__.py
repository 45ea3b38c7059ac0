"""The forms in which a calibration is written, and where its files go."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, UTC
from pathlib import Path
import shutil

from handeye_ros.data import Calibration
from handeye_ros.errors import UnknownNameError, UnwritableError
from handeye_ros.output import write_whole
from handeye_ros.results import calibration_file
from handeye_ros.results.exports import easy_handeye2, robots, ros
from handeye_ros.results.exports.format import as_json, Format, matrix

OFFERED = ('REPORT', 'format.matrix', 'ros')

YAML = 'yaml'
REPORT = 'report.html'
HISTORY = 'history'  # the folder of former results, each in a folder named after its time

FORMATS = {
    YAML: Format('calibration.yaml: the complete answer; handeye reads it',
                 lambda _: calibration_file.NAME, calibration_file.text),
    'urdf': Format('a <joint> with <origin xyz rpy>, for a URDF or a xacro file',
                   lambda _: 'sensor.urdf.xacro', ros.urdf),
    'launch': Format('a launch file that starts static_transform_publisher',
                     lambda _: ros.LAUNCH_FILE, ros.launch),
    'shell': Format('a shell script that starts static_transform_publisher',
                    lambda _: 'static_transform.sh', ros.shell),
    'easy_handeye2': Format('the .calib file of easy_handeye2', easy_handeye2.file_name,
                            easy_handeye2.text),
    'matrix': Format('the 4x4 matrix as text', lambda _: 'matrix.txt', matrix),
    'json': Format('JSON', lambda _: 'calibration.json', as_json),
    **robots.FORMATS,
}


@dataclass(frozen=True)
class Saved:
    """The files that were written, and the folder of what was there before; all absolute."""

    files: tuple[Path, ...]
    former: Path | None

    def __str__(self) -> str:
        """Tell a person where everything is."""
        kept = f'; the former result is kept in {self.former}' if self.former else ''
        return f'wrote {", ".join(map(str, self.files))}{kept}'


def of(name: str) -> Format:
    """Return the format of a name; raises UnknownNameError."""
    if name not in FORMATS:
        raise UnknownNameError('format', name, list(FORMATS))
    return FORMATS[name]


def save_all(calibration: Calibration, folder: Path, formats: Sequence[str] = (YAML,)) -> Saved:
    """
    Write a calibration into a folder, in each of the formats, and always as calibration.yaml.

    What the folder holds of a former result goes to history/<its time> in it, so that nothing
    is lost and no file is left that tells of another answer than the rest. Raises
    UnknownNameError, and UnwritableError for what cannot be written.
    """
    wanted = {name: of(name) for name in dict.fromkeys((YAML, *formats))}
    calibration = calibration_file.dated(calibration)
    texts = {form.file_name(calibration): form.text(calibration) for form in wanted.values()}
    folder = folder.expanduser().absolute()
    ours = {form.file_name(calibration) for form in FORMATS.values()} | {REPORT}
    former = set_aside(folder, sorted(ours), set(texts))
    for name, text in texts.items():
        write_whole(folder / name, text)
    return Saved(tuple(folder / name for name in texts), former)


def export(calibration: Calibration, name: str, file: Path) -> Saved:
    """
    Write a calibration in one format; a file of another content that is there is kept aside.

    Raises UnknownNameError and UnwritableError.
    """
    file, text = file.expanduser().absolute(), of(name).text(calibration)
    same = file.is_file() and file.read_bytes() == text.encode()
    former = None if same else set_aside(file.parent, [file.name], {file.name})
    write_whole(file, text)
    return Saved((file,), former)


def set_aside(folder: Path, names: Sequence[str], replaced: set[str]) -> Path | None:
    """
    Keep the files of a folder in its history; return where, None when there are none.

    replaced: of the names, those that are written again next: they stay until then, so that
    at no time there is none. Raises UnwritableError.
    """
    there = [folder / name for name in names if (folder / name).is_file()]
    if not there:
        return None
    try:
        kept = _new_folder(folder / HISTORY, max(file.stat().st_mtime for file in there))
        for file in there:
            shutil.copy2(file, kept / file.name)
        for file in there:
            if file.name not in replaced:
                file.unlink()
    except OSError as error:
        raise UnwritableError(folder / HISTORY, error.strerror or str(error)) from error
    return kept


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
