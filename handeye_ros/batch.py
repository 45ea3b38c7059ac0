# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Runs one verb on many recordings with Dask: a folder for each, one table, one page."""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import partial
import io
import json
import os
from pathlib import Path
import shlex
import shutil
import signal
import time
from typing import Any, TypeAlias

from handeye_ros import __version__
from handeye_ros.bags.storage import SUFFIXES
from handeye_ros.config import read_yaml
from handeye_ros.csv_tables import CsvTable
from handeye_ros.errors import DataError, ERROR_MARK, InputError, WARNING_MARK
from handeye_ros.output import csv_text, write_atomically
from handeye_ros.results.templates import rendered
from handeye_ros.se3 import AXES
from handeye_ros.verification.routines import ROUTINES
from handeye_ros.words import count_of, without_numbers

# of the table: label, bag, verb, exit_code, cause, warnings, seconds, computed (not taken from
# before), and figures of the result
JobRow: TypeAlias = dict[str, Any]
# runs `handeye` with arguments, the verb first, in its process; returns the exit code
RunVerb: TypeAlias = Callable[[list[str]], int]

LIST_COLUMNS = {'bag', 'label', 'config', 'settings', 'args'}  # of a list
JOB_FILE = 'job.json'  # in the folder of a job: what it was computed from, and its row
OUTPUTS = {'solve': '', 'verify': 'verification.yaml', 'check': 'check.yaml',
           'compare': 'comparison.yaml'}  # below --out, by verb of BatchVerb
# options and keys of these verbs that hold a path
PATH_OPTIONS = ('--config', '--kinematics', '--calibration', '--against', '--protocol')
PATH_KEYS = ('kinematics', 'verify.calibration', 'output_dir')
# of a result, beside its numbers
WORD_KEYS = ('child_frame', 'target', 'routine', 'against', 'method', 'verdict',
             'weakest_direction')
CRASH_EXIT_CODE = 70  # exit code of a job that ended in an error of the program (sysexits.h)
# Of the page: a figure, its heading, its factor.
RESULT_FIGURES = (
    ('residual_rms', 'residual RMS [mm]', 1e3), ('holdout_rms', 'left-out RMS [mm]', 1e3),
    ('rms', 'RMS [mm]', 1e3), ('points_off', 'points off [mm]', 1e3),
    ('smallest_error', 'smallest error that shows [mm]', 1e3), ('seconds', 'time [s]', 1.0))
LOCAL_DASK = {  # settings of Dask on this machine
    # a worker is given one job at a time, so that a job that ends it takes no other along
    'distributed.scheduler.worker-saturation': 1.0,
    'distributed.scheduler.allowed-failures': 1,
    # the client handles ctrl-C and ends the workers
    'distributed.worker.preload': ['import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)']}


@dataclass(frozen=True)
class Job:
    """A recording, its folder below the results, and the verb and arguments run on it."""

    bag: str
    label: str
    verb: str
    arguments: tuple[str, ...] = ()

    def command(self, folder: Path) -> list[str]:
        """Return the arguments of `handeye`, the verb first; folder: where its results are put."""
        return [self.verb, *self.arguments, self.bag, '--out', str(folder / OUTPUTS[self.verb])]

    def fingerprint(self) -> list[Any]:
        """
        Return what the result depends on: the version, the command, and its files.

        Of the recording and of every file that the arguments name these are path, size (bytes)
        and modification time (ns).
        """
        values = (argument.rpartition('=')[2] for argument in self.arguments)
        paths = (Path(self.bag), *(Path(value) for value in values if os.path.isabs(value)))
        return [__version__, self.command(Path()), *(
            [str(file), file.stat().st_size, file.stat().st_mtime_ns]
            for path in paths for file in files_below(path))]


def files_below(path: Path) -> list[Path]:
    """Return the files in a folder, following links, or a file itself; none of another path."""
    if path.is_file():
        return [path]
    files: list[Path] = []
    for folder, inside, names in os.walk(path, followlinks=True):
        real = Path(folder).resolve()
        inside[:] = [name for name in inside  # without links to a folder above
                     if (real / name).resolve() not in (real, *real.parents)]
        files += filter(Path.is_file, (Path(folder, name) for name in names))
    return sorted(files)


def jobs_of(sources: Sequence[str], verb: str, arguments: tuple[str, ...] = ()) -> list[Job]:
    """
    Return the jobs of bags, folders of bags, and CSV lists.

    verb, arguments: those of every job; a list adds arguments of its own. Raises InputError for a
    list that cannot be read, for labels that are no folders of their own, and where there is no
    recording.
    """
    jobs: list[Job] = []
    for source in map(Path, sources):
        if not source.exists():
            raise InputError(f'{source} is not there: give bags, folders of bags, or a CSV list')
        if source.suffix == '.csv' and source.is_file():
            jobs += _jobs_of_list(source, verb, arguments)
        else:
            jobs += [Job(str(bag.absolute()), label, verb, arguments)
                     for bag, label in _bags_in(source, several=len(sources) > 1)]
    if not jobs:
        raise InputError(f'no recording in {" ".join(sources)}: give bags, folders of bags, or a '
                         'CSV list of them')
    labels = [Path(job.label) for job in jobs]
    uses = Counter(folder for label in labels for folder in (label, *label.parents))
    for label in labels:  # results replace the folder of their label
        if not label.parts or uses[label] > 1 or label.is_absolute() or '..' in label.parts:
            raise InputError(f'the label "{label}" ({count_of(uses[label], "recording")}) is no '
                             'folder of its own inside that of the results: give each another '
                             'label in a CSV list (bag,label)')
    return jobs


def _bags_in(source: Path, several: bool) -> Iterator[tuple[Path, str]]:
    """Yield the bags at a path, and their labels; several: these begin with the folder's name."""
    files = [file.relative_to(source) for file in files_below(source)]
    folders = {file.parent for file in files if file.name == 'metadata.yaml'}
    if Path() in {*files, *folders}:
        yield source, _label_of(source.resolve())
        return
    single = {file for file in files
              if file.name.endswith(SUFFIXES) and file.parent not in folders}
    for bag in sorted(folders | single):
        label = bag.with_name(_label_of(bag))
        yield source / bag, str(source.resolve().name / label if several else label)


def _label_of(bag: Path) -> str:
    """Return the name of a bag, that of a file without its suffix."""
    return bag.stem if bag.suffix in SUFFIXES else bag.name


def arguments_of(args: str, config: Path | str | None, settings: Iterable[str],
                 folder: Path = Path()) -> tuple[str, ...]:
    """
    Return the arguments of a command, for workers: the paths that exist are absolute.

    These are the values of PATH_OPTIONS and PATH_KEYS, and further recordings; the routine of
    verify is none. args: as typed; settings: texts KEY=VALUE; folder: paths are relative to it.
    Raises InputError for args that cannot be split.
    """
    try:
        arguments = [part for word in shlex.split(args)
                     for part in (word.split('=', 1) if word[:2] == '--' else [word])]
    except ValueError as error:
        raise InputError(f'args: {args!r} has a quotation mark that is not closed') from error
    arguments += [argument for text in settings for argument in ('--set', text)]

    def with_absolute_path(option: str, argument: str) -> str:
        """Return an argument after another one, an option or not."""
        key, equals, value = argument.partition('=') if option == '--set' else ('', '', argument)
        is_path = (key in PATH_KEYS if option == '--set' else
                   option in PATH_OPTIONS if option[:2] == '--' else value not in ROUTINES)
        return (f'{key}{equals}{(folder / value).absolute()}'
                if is_path and value and (folder / value).exists() else argument)
    files = ['--config', str((folder / config).absolute())] if config else []
    return (*map(with_absolute_path, ['', *arguments], arguments), *files)


def _jobs_of_list(path: Path, verb: str, arguments: tuple[str, ...]) -> Iterator[Job]:
    """Yield the jobs of a list, whose paths are relative to it."""
    table, folder = CsvTable(path), path.absolute().parent
    if not LIST_COLUMNS.issuperset(table.columns) or '' in table.texts('bag'):
        raise InputError(f'{path}: it has the columns {", ".join(table.columns)}; expected bag, '
                         'with a value in each row, and, if wanted, label, config, settings, args')
    for values in zip(*map(table.texts, table.columns), strict=True):
        row = dict(zip(table.columns, values, strict=True))
        own = arguments_of(row.get('args', ''), row.get('config'),
                           row.get('settings', '').split(), folder)
        label = row.get('label') or _label_of(Path(row['bag']))
        yield Job(str(folder / row['bag']), label, verb, (*arguments, *own))


@contextmanager
def client_of(scheduler: str) -> Iterator[Any]:
    """
    Give a Dask client of a cluster on this machine (`local`), or of the scheduler at an address.

    Raises InputError.
    """
    try:
        import dask
        from distributed import Client
    except ImportError as error:
        raise InputError(f'batch needs {error.name}, which is not installed: pip install '
                         '"handeye_ros[batch]"') from error
    cluster: dict[str, Any] = {'address': scheduler, 'timeout': 5}
    if scheduler == 'local':
        cluster = {'n_workers': len(os.sched_getaffinity(0)), 'threads_per_worker': 1,
                   'silence_logs': 50, 'dashboard_address': '127.0.0.1:0', 'timeout': 60}
    with dask.config.set(LOCAL_DASK):
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)  # for workers that start, too
        try:
            client = Client(**cluster)
        except (OSError, ValueError) as error:
            raise InputError(f'no Dask scheduler answers at {scheduler}: start one with "dask '
                             'scheduler" and workers with "dask worker ADDRESS --nthreads 1"'
                             ) from error
        finally:
            signal.signal(signal.SIGINT, handler)
        with client:
            yield client


def job_rows(jobs: Sequence[Job], out: Path, run_verb: RunVerb, scheduler: str = 'local'
             ) -> Iterator[JobRow]:
    """
    Yield the row of each job: of the unchanged at once, of the others when they are done.

    out: the folder of the results; scheduler: 'local' or the address of one, which is asked only
    where there is something to compute. A worker that ends costs only its own job. Raises
    InputError where no scheduler answers, and for a folder that is there but holds no result.
    """
    for folder in (out / job.label for job in jobs):
        if folder.exists() and not (folder / JOB_FILE).is_file():
            raise InputError(f'{folder} is there and holds no result of batch, so it is not '
                             'replaced: name another folder with --out')
        if results := [parent for parent in folder.parents if (parent / JOB_FILE).is_file()]:
            raise InputError(f'{folder} would be inside the result {results[0]}, and be lost with '
                             'it: name another folder with --out')
    earlier_rows = [earlier_row(job, out) for job in jobs]
    yield from filter(None, earlier_rows)
    pending = [job for job, row in zip(jobs, earlier_rows, strict=True) if row is None]
    if not pending:
        return
    with client_of(scheduler) as workers:
        from distributed import as_completed
        # an entry is given up with its result, as a future that is held keeps it in memory
        job_of_future = dict(zip(
            workers.map(partial(run, out=out, run_verb=run_verb), pending, pure=False), pending,
            strict=True))
        for future, result in as_completed(job_of_future, with_results=True, raise_errors=False):
            job, error = job_of_future.pop(future), future.exception()
            yield result if error is None else {
                'label': job.label, 'bag': job.bag, 'verb': job.verb, 'exit_code': CRASH_EXIT_CODE,
                'cause': f'{type(error).__name__}: {error}', 'computed': True}


def earlier_row(job: Job, out: Path) -> JobRow | None:
    """Return the row of a job from its folder below out, None where the job must be run."""
    try:
        previous = json.loads((out / job.label / JOB_FILE).read_text(encoding='utf-8'))
        same = (previous['fingerprint'] == job.fingerprint()
                and previous['row']['exit_code'] != CRASH_EXIT_CODE)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return {**previous['row'], 'computed': False} if same else None


def run(job: Job, out: Path, run_verb: RunVerb) -> JobRow:
    """Return the row of a job after running it; its folder below out appears whole or not."""
    folder = out / job.label
    unfinished = folder.with_name(f'.{folder.name}.handeye-batch')
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    start, fingerprint = time.perf_counter(), job.fingerprint()
    printed, errors = io.StringIO(), io.StringIO()
    try:
        with redirect_stdout(printed), redirect_stderr(errors):
            code = run_verb(job.command(unfinished))
    except Exception as error:  # noqa: BLE001 - costs this job alone
        code = CRASH_EXIT_CODE
        errors.write(f'{ERROR_MARK}{type(error).__name__}: {error}')
    write_atomically(unfinished / 'output.txt', printed.getvalue() + errors.getvalue())
    lines = errors.getvalue().splitlines()
    cause = next((line[len(ERROR_MARK):] for line in lines
                  if line.lower().startswith(ERROR_MARK)), '')  # typer's are "Error: "
    row = {'label': job.label, 'bag': job.bag, 'verb': job.verb, 'exit_code': code,
           'cause': cause, 'warnings': sum(line.startswith(WARNING_MARK) for line in lines),
           'seconds': round(time.perf_counter() - start, 3), **_figures_in(unfinished)}
    write_atomically(unfinished / JOB_FILE,
                     json.dumps({'fingerprint': fingerprint, 'row': row}, indent=1))
    shutil.rmtree(folder, ignore_errors=True)
    unfinished.replace(folder)
    return {**row, 'computed': True}


def _figures_in(folder: Path) -> JobRow:
    """Return the numbers and WORD_KEYS of the result in a folder, by column."""
    values: JobRow = {}
    for file in sorted(folder.glob('*.yaml')):
        content = read_yaml(file)
        transform = content.get('transform', {})
        config = content.get('provenance', {}).get('config', {})
        for part in ({**content, 'target': config.get('target.type')}, content.get('quality', {}),
                     transform.get('translation', {}), *content.get('checks', ())):
            values |= _figures(part)
        values |= _figures(transform.get('rotation', {}), 'q')
        for item in (*content.get('estimators', ()), *content.get('quantities', ())):
            values |= _figures(item, f'{item["name"]} ')
        if 'covariance' in content:
            values |= {f'std_{axis}': content['covariance'][7 * k] ** 0.5
                       for k, axis in enumerate(AXES)}
    return values


def _figures(content: Mapping[str, Any], prefix: str = '') -> JobRow:
    """Return the numbers and WORD_KEYS directly in a mapping, by their names after a prefix."""
    return {f'{prefix}{name}': value for name, value in content.items()
            if isinstance(value, (int, float)) or name in WORD_KEYS and value}


def outcome_of(row: JobRow) -> str:
    """Return the outcome of a job: pass, warning, its verdict, unusable, refused or crashed."""
    if row['exit_code'] == 0:
        return 'warning' if row.get('warnings') else 'pass'
    return {1: row.get('verdict'), InputError.exit_code: 'unusable',
            DataError.exit_code: 'refused'}.get(row['exit_code']) or 'crashed'


def write_table(rows: Sequence[JobRow], out: Path) -> None:
    """Write results.csv and report.html; raises UnwritableError."""
    rows = sorted(rows, key=lambda row: row['label'])
    names = list(dict.fromkeys(name for row in rows for name in row))
    write_atomically(out / 'results.csv',
                     csv_text(names, ([row.get(name) for name in names] for row in rows)))
    worst_first = sorted(rows, key=lambda row: (
        -row['exit_code'], -(row.get('residual_rms') or row.get('rms') or 0.0)))
    causes: dict[str, list[JobRow]] = {}
    for row in worst_first:
        if row.get('cause'):
            causes.setdefault(without_numbers(row['cause']), []).append(row)
    write_atomically(out / 'report.html', rendered(
        'batch.html', rows=worst_first, result=outcome_of,
        figures=[figure for figure in RESULT_FIGURES
                 if any(row.get(figure[0]) is not None for row in rows)],
        causes=sorted(causes.values(), key=len, reverse=True),
        counts=Counter(map(outcome_of, rows)).most_common(),
        link_of=lambda row: next(filter(lambda link: (out / link).exists(), (
            f'{row["label"]}/{name}' for name in ('report.html', 'output.txt'))), '')))
