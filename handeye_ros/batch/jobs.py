"""One job of a batch: from its recording, local or at a URL, to its row."""
from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
import fcntl
import hashlib
import io
import json
import os
from pathlib import Path, PurePosixPath
import shutil
import tempfile
import time
from typing import Any, TypeAlias

from handeye_ros import __version__
from handeye_ros.batch.errors import NoDaskError, RemoteError
from handeye_ros.errors import HandeyeError
from handeye_ros.output import write_whole
import yaml

Row: TypeAlias = dict[str, Any]
Verb: TypeAlias = Callable[[list[str]], int]
JOB = 'job.json'  # in the folder of a job: its key and its row
LOCKS = '.locks'  # in the folder of all: one locked byte for each running job
OUTPUTS = {'solve': '', 'verify': 'verification.yaml', 'check': 'check.yaml',
           'compare': 'comparison.yaml'}  # below --out
NOT_FIGURES = ('format', 'version', 'name', 'input', 'against', 'sentence', 'routine',
               'parent_frame', 'child_frame')
UNREADABLE = 2  # exit code
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
        return [*words, '--out', str(folder / OUTPUTS[self.verb])]

    def key(self) -> str:
        """Return a hash of everything that determines the result: files, command and version."""
        total = hashlib.sha256(repr((__version__, replace(self, label=''))).encode())
        if is_remote(self.bag):
            total.update(fingerprint(self.bag).encode())
        words = filter(os.path.isfile, self.args)
        for path in map(Path, filter(os.path.exists, [self.bag, *words, self.config])):
            for file in sorted(path.rglob('*')) if path.is_dir() else [path]:
                if file.is_file():
                    with file.open('rb') as stream:
                        total.update(hashlib.file_digest(stream, 'sha256').digest())
        return total.hexdigest()


def run(job: Job, out: Path, verb: Verb) -> Row:
    """
    Return the row of a job, from its folder below out if it is unchanged.

    verb: runs the words of a command in this process, and returns its exit code. The folder
    appears complete or not at all. If another worker still runs this job, wait for it: its client
    may have been killed.
    """
    folder = out / job.label
    out.mkdir(parents=True, exist_ok=True)
    with _locked(out / LOCKS, job.label):
        try:
            key = job.key()
        except HandeyeError as error:  # a missing remote recording
            key = str(error)
        try:
            previous = json.loads((folder / JOB).read_text(encoding='utf-8'))
            lost = is_remote(job.bag) and previous['row']['exit_code'] == UNREADABLE
            if previous['key'] == key and not lost:  # a lost connection may work again
                return {**previous['row'], 'computed': False}
        except (OSError, ValueError, KeyError):
            pass
        unfinished = folder.with_name(f'.{folder.name}.part')
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir(parents=True)
        row = {**_answered(job, unfinished, verb), 'worker': os.getpid()}
        write_whole(unfinished / JOB, json.dumps({'key': key, 'row': row}, indent=1))
        shutil.rmtree(folder, ignore_errors=True)
        unfinished.replace(folder)
        return {**row, 'computed': True}


@contextmanager
def _locked(file: Path, label: str) -> Iterator[None]:
    """Lock a label against other processes; the system releases it when the process ends."""
    with file.open('ab') as stream:
        byte = int.from_bytes(hashlib.sha256(label.encode()).digest()[:7], 'big')
        fcntl.lockf(stream, fcntl.LOCK_EX, 1, byte)
        yield


def _answered(job: Job, folder: Path, verb: Verb) -> Row:
    """Return the row of a job after running it, and store its output."""
    start, printed, errors = time.perf_counter(), io.StringIO(), io.StringIO()
    try:
        with redirect_stdout(printed), redirect_stderr(errors), local_copy(job.bag) as bag:
            code = verb(replace(job, bag=bag).command(folder))
    except HandeyeError as error:
        code = error.exit_code
        errors.write(f'error: {error}')
    except Exception as error:  # noqa: BLE001 - costs this job alone
        code = CRASHED
        errors.write(f'error: {type(error).__name__}: {error}')
    write_whole(folder / 'output.txt', printed.getvalue() + errors.getvalue())
    lines = errors.getvalue().splitlines()
    cause = next((line for line in lines if line.startswith('error:')), '')
    return {'label': job.label, 'bag': job.bag, 'verb': job.verb, 'exit_code': code,
            'cause': cause.removeprefix('error: '),
            'warnings': sum(line.startswith('warning:') for line in lines),
            'seconds': round(time.perf_counter() - start, 3), **_values(folder)}


def _values(folder: Path) -> Row:
    """Return the figures of calibration.yaml, verification.yaml or check.yaml in a folder."""
    values: Row = {}
    for file in sorted(folder.glob('*.yaml')):
        try:
            content = yaml.load(file.read_text(encoding='utf-8'),
                                Loader=getattr(yaml, 'CSafeLoader', yaml.SafeLoader))
        except (OSError, yaml.YAMLError):
            continue
        if isinstance(content, dict):
            values |= _figures(content)
    return values


def _figures(content: dict[str, Any]) -> Row:
    """Return the figures of one file's content."""
    stamps = [sample['stamp'] for sample in content.get('samples') or []]
    values: Row = {'stamp': min(stamps)} if stamps else {}
    for group in (content, *(content.get('checks') or []), content.get('quality') or {}):
        values |= {name: value for name, value in group.items()
                   if isinstance(value, (int, float, str)) and name not in NOT_FIGURES}
    for estimator in content.get('estimators') or []:
        values |= {f'{estimator["name"]} {name}': value for name, value in estimator.items()
                   if name not in ('name', 'transform')}
    for quantity in content.get('quantities') or []:
        values |= {f'{quantity["name"]}{ending}': quantity[name]
                   for name, ending in (('value', ''), ('std', '_std'))}
    for name, group in (content.get('transform') or {}).items():
        letter = 'q' if name == 'rotation' else ''
        values |= {f'{letter}{axis}': value for axis, value in group.items()}
    if 'covariance' in content:
        values |= {f'std_{axis}': content['covariance'][7 * k] ** 0.5
                   for k, axis in enumerate(('x', 'y', 'z', 'rx', 'ry', 'rz'))}
    return values


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
        system.invalidate_cache()  # a long-lived worker caches old listings
        yield system, path
    except Exception as error:  # each file system raises errors of its own
        raise RemoteError(url, f'{type(error).__name__}: {error}') from error


def files_below(source: str) -> list[str] | None:
    """Return the files below a folder, relative to it; None for other paths."""
    if not is_remote(source):
        folder = Path(source)
        return [file.relative_to(folder).as_posix() for file in folder.rglob('*')
                ] if folder.is_dir() else None
    with opened(source) as (system, path):
        if not system.isdir(path):
            return None
        return [file[len(path):].lstrip('/') for file in system.find(path)]


def fingerprint(url: str) -> str:
    """Return a value that changes with a remote recording, without reading it."""
    with opened(url) as (system, path):
        state = system.info if 'http' in system.protocol else system.ukey  # ukey: of the URL alone
        return ' '.join(str(state(file)) for file in sorted(system.find(path)))


@contextmanager
def local_copy(source: str) -> Iterator[str]:
    """Give the path of a recording, copied to a temporary folder if it is remote."""
    if not is_remote(source):
        yield source
        return
    with tempfile.TemporaryDirectory(prefix='handeye_batch_') as folder:
        copy = Path(folder, PurePosixPath(source).name)
        files = files_below(source)
        with opened(source) as (system, path):
            for file in [''] if files is None else files:
                (copy / file).parent.mkdir(parents=True, exist_ok=True)
                system.get_file(f'{path}/{file}'.rstrip('/'), str(copy / file))
        yield str(copy)
