"""The jobs of a batch: which recordings, and one of them from its command to its row."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
import csv
from dataclasses import dataclass, replace
import hashlib
import io
import json
import os
from pathlib import Path
import shlex
import shutil
import time
from typing import Any, TypeAlias

from handeye_ros import __version__
from handeye_ros.batch.errors import JobListError, NoJobsError
from handeye_ros.results.calibration_file import write_whole
import yaml

Row: TypeAlias = dict[str, Any]
Verb: TypeAlias = Callable[[list[str]], int]
JOB = 'job.json'  # in the folder of a job: its key and its row
BAGS = ('.mcap', '.db3')
LISTS = ('.csv', '.yaml', '.yml')
OUTPUTS = {'solve': '', 'verify': 'verification.yaml', 'check': 'check.yaml'}  # below --out
CRASHED = 70  # exit code of a job that ended in an error of the program (sysexits.h)


@dataclass(frozen=True)
class Job:
    """A recording, its name in the results, and the words of its command."""

    bag: str
    label: str
    verb: str
    args: tuple[str, ...] = ()
    config: str = ''
    settings: tuple[str, ...] = ()

    def command(self, folder: Path) -> list[str]:
        """Return the words after `handeye`; folder: of the results."""
        words = [self.verb, *self.args, self.bag, *(['--config', self.config] * bool(self.config))]
        for setting in self.settings:
            words += ['--set', setting]
        if self.verb in OUTPUTS:
            words += ['--out', str(folder / OUTPUTS[self.verb])]
        return words

    def key(self) -> str:
        """Return a hash of all that the result depends on: files, command and version."""
        total = hashlib.sha256(repr((__version__, replace(self, label=''))).encode())
        words = [word for word in self.args if Path(word).is_file()]
        for path in map(Path, [self.bag, *words, *([self.config] if self.config else [])]):
            for file in sorted(path.rglob('*')) if path.is_dir() else [path]:
                if file.is_file():
                    with file.open('rb') as stream:
                        total.update(hashlib.file_digest(stream, 'sha256').digest())
        return total.hexdigest()


def jobs_of(sources: Sequence[Path], base: Job) -> list[Job]:
    """
    Return the jobs of bags, folders of bags, and CSV or YAML lists; base: what they share.

    Raises JobListError, NoJobsError.
    """
    jobs: list[Job] = []
    for source in sources:
        if source.suffix in LISTS and source.is_file():
            jobs += _listed(source, base)
        else:
            jobs += [replace(base, bag=str(bag.absolute()), label=label)
                     for bag, label in _bags_in(source)]
    if not jobs:
        raise NoJobsError(' '.join(map(str, sources)))
    seen: dict[str, int] = {}
    unique = []
    for job in jobs:
        seen[job.label] = seen.get(job.label, 0) + 1
        number = seen[job.label]
        unique.append(job if number == 1 else replace(job, label=f'{job.label}-{number}'))
    return unique


def _bags_in(source: Path) -> Iterator[tuple[Path, str]]:
    """Yield the bags that a path is or holds, and their names."""
    if (source / 'metadata.yaml').exists() or source.suffix in BAGS or not source.is_dir():
        yield source, source.stem
        return
    folders = {file.parent for file in source.rglob('metadata.yaml')}
    files = {file for ending in BAGS for file in source.rglob(f'*{ending}')
             if file.parent not in folders}
    for bag in sorted(folders | files):
        yield bag, str(bag.relative_to(source).with_suffix(''))


def _listed(path: Path, base: Job) -> Iterable[Job]:
    """Return the jobs of a list, whose paths are relative to it."""
    try:
        text = path.read_text(encoding='utf-8')
        rows = (list(csv.DictReader(io.StringIO(text), skipinitialspace=True))
                if path.suffix == '.csv' else yaml.safe_load(text))
        for row in rows:
            settings = row.get('settings') or ''
            words = settings.split() if isinstance(settings, str) else [
                f'{k}={v}' for k, v in settings.items()]
            bag = path.parent / row['bag']
            config = row.get('config')
            yield replace(
                base, bag=str(bag.absolute()), label=str(row.get('label') or bag.stem),
                config=str((path.parent / config).absolute()) if config else base.config,
                settings=(*base.settings, *words),
                args=(*base.args, *shlex.split(row.get('args') or '')))
    except (OSError, KeyError, TypeError, AttributeError, ValueError, yaml.YAMLError) as error:
        raise JobListError(path, f'{type(error).__name__}: {error}') from error


def run(job: Job, out: Path, verb: Verb) -> Row:
    """
    Return the row of a job, from its folder below out where nothing changed since.

    verb: runs the words of a command in this process, and returns its exit code. What it writes
    is there whole or not at all.
    """
    folder, key = out / job.label, job.key()
    try:
        known = json.loads((folder / JOB).read_text(encoding='utf-8'))
        if known['key'] == key:
            return {**known['row'], 'computed': False}
    except (OSError, ValueError, KeyError):
        pass
    part = folder.with_name(f'.{folder.name}.{os.getpid()}.part')
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    row = {**_answered(job, part, verb), 'worker': os.getpid()}
    write_whole(part / JOB, json.dumps({'key': key, 'row': row}, indent=1))
    shutil.rmtree(folder, ignore_errors=True)
    part.replace(folder)
    return {**row, 'computed': True}


def _answered(job: Job, folder: Path, verb: Verb) -> Row:
    """Return the row of a job that is computed now, and keep what it printed."""
    start, said, errors = time.perf_counter(), io.StringIO(), io.StringIO()
    try:
        with redirect_stdout(said), redirect_stderr(errors):
            code = verb(job.command(folder))
    except Exception as error:  # noqa: BLE001 - costs this job alone
        code = CRASHED
        errors.write(f'error: {type(error).__name__}: {error}')
    write_whole(folder / 'output.txt', said.getvalue() + errors.getvalue())
    lines = errors.getvalue().splitlines()
    cause = next((line for line in lines if line.startswith('error:')), '')
    return {'label': job.label, 'bag': job.bag, 'verb': job.verb, 'exit_code': code,
            'cause': cause.removeprefix('error: '),
            'warnings': sum(line.startswith('warning:') for line in lines),
            'seconds': round(time.perf_counter() - start, 3), **_values(folder)}


def _values(folder: Path) -> Row:
    """Return the figures of calibration.yaml, verification.yaml or check.yaml in a folder."""
    found: Row = {}
    for file in sorted(folder.glob('*.yaml')):
        try:
            told = yaml.load(file.read_text(encoding='utf-8'),
                             Loader=getattr(yaml, 'CSafeLoader', yaml.SafeLoader))
        except (OSError, yaml.YAMLError):
            continue
        told = told if isinstance(told, dict) else {}
        found |= {name: told[name] for name in ('verdict', 'method') if name in told}
        for name, group in (told.get('transform') or {}).items():
            letter = 'q' if name == 'rotation' else ''
            found |= {f'{letter}{axis}': value for axis, value in group.items()}
        if 'covariance' in told:
            found |= {f'std_{axis}': told['covariance'][7 * k] ** 0.5
                      for k, axis in enumerate(('x', 'y', 'z', 'rx', 'ry', 'rz'))}
        found |= {name: value for name, value in (told.get('quality') or {}).items()
                  if isinstance(value, (int, float, str))}
    return found
