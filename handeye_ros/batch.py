# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Runs one verb on many recordings with Dask: a folder for each, one table, one page."""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, ExitStack, redirect_stderr, redirect_stdout
import csv
from dataclasses import dataclass, replace
from functools import partial
import io
import json
import os
from pathlib import Path, PurePosixPath
import re
import shlex
import shutil
import tempfile
import time
from typing import Any, TypeAlias

from handeye_ros import __version__, trend
from handeye_ros.errors import DataError, HandeyeError, InputError
from handeye_ros.output import csv_text, page, write_whole
import yaml

Row: TypeAlias = dict[str, Any]
Verb: TypeAlias = Callable[[list[str]], int]

BAGS, LISTS = ('.mcap', '.db3'), ('.csv', '.yaml', '.yml')
COLUMNS = {'bag', 'label', 'config', 'settings', 'args'}  # of a list
JOB = 'job.json'  # in the folder of a job: what it was computed from, and its row
OUTPUTS = {'solve': '', 'verify': 'verification.yaml', 'check': 'check.yaml',
           'compare': 'comparison.yaml'}  # below --out, by verb
NOT_FIGURES = ('format', 'version', 'name', 'input', 'against', 'sentence', 'routine',
               'parent_frame', 'child_frame')
CHANGES = ('mtime', 'LastModified', 'updated', 'ETag', 'created')  # what file systems tell
CRASHED = 70  # exit code of a job that ended in an error of the program (sysexits.h)
WORST = 10  # recordings with a report
# Of the page: a figure, its heading, its factor.
FIGURES = (('residual_rms', 'residual RMS [mm]', 1e3), ('holdout_rms', 'left out RMS [mm]', 1e3),
           ('rms', 'RMS [mm]', 1e3), ('points_off', 'points off [mm]', 1e3),
           ('smallest_error', 'smallest error that shows [mm]', 1e3), ('seconds', 'time [s]', 1.0))
LOCAL = {  # settings of Dask on this machine
    # a worker is given one job at a time, so that a job that ends it takes no other along
    'distributed.scheduler.worker-saturation': 1.0,
    'distributed.scheduler.allowed-failures': 1,
    # the client handles ctrl-C and ends the workers
    'distributed.worker.preload': ['import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)']}


@dataclass(frozen=True)
class Job:
    """A recording (a path or a URL), its name in the results, and the words of its command."""

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

    def state(self) -> list[Any] | None:
        """
        Return what the result depends on: version, command, and size and time of all files.

        None where a file system does not tell when a file has changed. Raises InputError for a
        URL that cannot be read.
        """
        state: list[Any] = [__version__, self.command(Path())]
        for source in filter(None, (self.bag, self.config, *self.args)):
            if not is_remote(source) and not Path(source).exists():
                continue
            with opened(source) as (system, path):
                for name, info in sorted(system.find(path, detail=True).items()):
                    changed = next((str(info[key]) for key in CHANGES if info.get(key)), '')
                    if not changed:
                        return None
                    state.append([name, info.get('size'), changed])
        return state


def is_remote(source: str) -> bool:
    """Return whether a source is a URL."""
    return '://' in source


@contextmanager
def opened(source: str) -> Iterator[tuple[Any, str]]:
    """Give the file system of a path or URL, and the path on it; raises InputError."""
    try:
        from fsspec.core import url_to_fs
        system, path = url_to_fs(source)
        system.invalidate_cache()  # a long-lived worker caches old listings
        yield system, path
    except Exception as error:  # each file system raises errors of its own
        raise InputError(f'{source} cannot be read ({type(error).__name__}: {error}): check it, '
                         'its credentials, and that the library of its file system (such as '
                         's3fs) is installed') from error


def jobs_of(sources: Sequence[str], base: Job) -> list[Job]:
    """
    Return the jobs of bags, folders of bags, and CSV or YAML lists; base: the common command.

    Raises InputError for a list or a URL that cannot be read, DataError without a recording.
    """
    jobs: list[Job] = []
    for source in sources:
        if source.endswith(LISTS) and Path(source).is_file():
            jobs += _listed(Path(source), base)
        elif is_remote(source) or Path(source).exists():
            jobs += [replace(base, bag=bag, label=label)
                     for bag, label in _bags_in(source, several=len(sources) > 1)]
    if not jobs:
        raise DataError(f'no recording in {" ".join(sources)}: give bags, folders of bags, or a '
                        'CSV or YAML list of them')
    counts = Counter[str]()
    unique = []
    for job in jobs:
        counts[job.label] += 1
        number = counts[job.label]
        unique.append(job if number == 1 else replace(job, label=f'{job.label}-{number}'))
    return unique


def _bags_in(source: str, several: bool) -> Iterator[tuple[str, str]]:
    """Yield the bags at a path or URL, and their names; several: with the folder's name."""
    with opened(source) as (system, path):
        files = [PurePosixPath(file).relative_to(path) for file in system.find(path)
                 ] if system.isdir(path) else None
    if files is None or PurePosixPath('metadata.yaml') in files:
        yield _absolute(source), PurePosixPath(source).stem
        return
    folders = {file.parent for file in files if file.name == 'metadata.yaml'}
    single = {file for file in files if file.suffix in BAGS and file.parent not in folders}
    for bag in sorted(folders | single):
        name = bag.with_suffix('')
        yield (f'{_absolute(source).rstrip("/")}/{bag}',
               str(PurePosixPath(source).name / name if several else name))


def _absolute(source: str | Path) -> str:
    return str(source) if is_remote(str(source)) else str(Path(source).absolute())


def words_of(text: str, folder: Path) -> tuple[str, ...]:
    """Return the words of a command with absolute paths of its files, for workers."""
    return tuple(str((folder / word).absolute()) if (folder / word).is_file() else word
                 for word in shlex.split(text))


def _listed(path: Path, base: Job) -> Iterable[Job]:
    """Yield the jobs of a list, whose paths are relative to it."""
    expected = ('expected a CSV or YAML list with bag and, if wanted, label, config, settings, '
                'args')
    try:
        text = path.read_text(encoding='utf-8')
        rows = (list(csv.DictReader(io.StringIO(text), skipinitialspace=True))
                if path.suffix == '.csv' else yaml.safe_load(text))
        for row in rows:
            if 'bag' not in row or not COLUMNS.issuperset(row):
                raise InputError(f'{path}: it has {", ".join(map(str, row))}; {expected}')
            settings = row.get('settings') or ''
            assignments = settings.split() if isinstance(settings, str) else [
                f'{k}={v}' for k, v in settings.items()]
            bag = row['bag'] if is_remote(row['bag']) else _absolute(path.parent / row['bag'])
            config = row.get('config')
            yield replace(
                base, bag=bag, label=str(row.get('label') or PurePosixPath(bag).stem),
                config=str((path.parent / config).absolute()) if config else base.config,
                settings=(*base.settings, *assignments),
                args=(*base.args, *words_of(row.get('args') or '', path.parent)))
    except (OSError, KeyError, TypeError, AttributeError, ValueError, yaml.YAMLError) as error:
        raise InputError(f'{path}: {type(error).__name__}: {error}; {expected}') from error


@contextmanager
def client_of(scheduler: str) -> Iterator[Any]:
    """Give a Dask client of a cluster on this machine (`local`), or of one; raises InputError."""
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise InputError(f'batch needs {error.name}, which is not installed: pip install '
                         '"handeye_ros[batch]"') from error
    with ExitStack() as stack:
        address: Any = scheduler
        if scheduler == 'local':
            stack.enter_context(dask.config.set(LOCAL))
            address = stack.enter_context(LocalCluster(
                n_workers=len(os.sched_getaffinity(0)), threads_per_worker=1, silence_logs=50,
                dashboard_address='127.0.0.1:0'))
        try:
            client = Client(address, timeout=60 if scheduler == 'local' else 5)
        except (OSError, ValueError) as error:
            raise InputError(f'no Dask scheduler answers at {scheduler}: start one with "dask '
                             'scheduler" and workers with "dask worker ADDRESS --nthreads 1"'
                             ) from error
        yield stack.enter_context(client)


def rows_of(jobs: Sequence[Job], out: Path, verb: Verb, scheduler: str = 'local'
            ) -> Iterator[Row]:
    """
    Yield the row of each job: of the unchanged at once, of the others when they are done.

    verb: runs the words of a command in a process, and returns its exit code; scheduler: its
    address, asked where there is something to compute. A worker that ends costs only its own
    job. At last the worst answers of `solve` get their report. Raises InputError.
    """
    rows = [row for row in (unchanged(job, out) for job in jobs) if row]
    yield from rows
    done = {row['label'] for row in rows}
    pending = [job for job in jobs if job.label not in done]
    if not pending:
        return
    with client_of(scheduler) as workers:
        from distributed import as_completed
        by_future = dict(zip(workers.map(partial(run, out=out, verb=verb), pending, pure=False),
                             pending, strict=True))
        for future, result in as_completed(by_future, with_results=True, raise_errors=False):
            job, error = by_future.pop(future), future.exception()
            rows.append(result if error is None else {
                'label': job.label, 'bag': job.bag, 'verb': job.verb, 'exit_code': CRASHED,
                'cause': f'{type(error).__name__}: {error}', 'computed': True})
            yield rows[-1]
        folders = [out / row['label'] for row in worst_answers(rows) if row['verb'] == 'solve']
        workers.gather(workers.map(
            partial(_quietly, verb), [['report', str(folder)] for folder in folders
                                      if not (folder / 'report.html').exists()],
            pure=False), errors='skip')


def _quietly(verb: Verb, words: list[str]) -> int:
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        return verb(words)


def unchanged(job: Job, out: Path) -> Row | None:
    """Return the row of a job from its folder below out if it would be computed from the same."""
    try:
        previous = json.loads((out / job.label / JOB).read_text(encoding='utf-8'))
        state = job.state()
        if state and previous['state'] == state:
            return {**previous['row'], 'computed': False}
    except (OSError, ValueError, KeyError, InputError):
        pass
    return None


def run(job: Job, out: Path, verb: Verb) -> Row:
    """Return the row of a job after running it; its folder below out appears whole or not."""
    folder = out / job.label
    unfinished = folder.with_name(f'.{folder.name}.part')
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    start, state = time.perf_counter(), None
    printed, errors = io.StringIO(), io.StringIO()
    try:
        state = job.state()
        with redirect_stdout(printed), redirect_stderr(errors), _local(job.bag) as bag:
            code = verb(replace(job, bag=bag).command(unfinished))
    except HandeyeError as error:
        code, state = error.exit_code, None  # a lost connection may work again
        errors.write(f'error: {error}')
    except Exception as error:  # noqa: BLE001 - costs this job alone
        code = CRASHED
        errors.write(f'error: {type(error).__name__}: {error}')
    write_whole(unfinished / 'output.txt', printed.getvalue() + errors.getvalue())
    lines = errors.getvalue().splitlines()
    cause = next((line for line in lines if line.startswith('error:')), '')
    row = {'label': job.label, 'bag': job.bag, 'verb': job.verb, 'exit_code': code,
           'cause': cause.removeprefix('error: '),
           'warnings': sum(line.startswith('warning:') for line in lines),
           'seconds': round(time.perf_counter() - start, 3), **_figures_in(unfinished)}
    write_whole(unfinished / JOB, json.dumps({'state': state, 'row': row}, indent=1))
    shutil.rmtree(folder, ignore_errors=True)
    unfinished.replace(folder)
    return {**row, 'computed': True}


@contextmanager
def _local(source: str) -> Iterator[str]:
    """Give the path of a recording, copied to a temporary folder if it is remote."""
    if not is_remote(source):
        yield source
        return
    with tempfile.TemporaryDirectory(prefix='handeye_batch_') as folder:
        copy = Path(folder, PurePosixPath(source).name)
        with opened(source) as (system, path):
            for file in system.find(path) if system.isdir(path) else [path]:
                place = copy / file[len(path):].lstrip('/')
                place.parent.mkdir(parents=True, exist_ok=True)
                system.get_file(file, str(place))
        yield str(copy)


def _figures_in(folder: Path) -> Row:
    """Return the figures of calibration.yaml, verification.yaml or check.yaml in a folder."""
    values: Row = {}
    for file in sorted(folder.glob('*.yaml')):
        content = yaml.load(file.read_text(encoding='utf-8'),
                            Loader=getattr(yaml, 'CSafeLoader', yaml.SafeLoader))
        stamps = [sample['stamp'] for sample in content.get('samples') or []]
        values |= {'stamp': min(stamps)} if stamps else {}
        for group in (content, *(content.get('checks') or []), content.get('quality') or {}):
            values |= {name: value for name, value in group.items()
                       if isinstance(value, (int, float, str)) and name not in NOT_FIGURES}
        for estimator in content.get('estimators') or []:
            values |= {f'{estimator["name"]} {name}': value for name, value in estimator.items()
                       if name not in ('name', 'transform')}
        for quantity in content.get('quantities') or []:
            values |= {quantity['name']: quantity['value'],
                       f'{quantity["name"]}_std': quantity['std']}
        for name, group in (content.get('transform') or {}).items():
            letter = 'q' if name == 'rotation' else ''
            values |= {f'{letter}{axis}': value for axis, value in group.items()}
        if 'covariance' in content:
            values |= {f'std_{axis}': content['covariance'][7 * k] ** 0.5
                       for k, axis in enumerate(('x', 'y', 'z', 'rx', 'ry', 'rz'))}
    return values


def result_of(row: Row) -> str:
    """Return the result of a job in one word."""
    if row['exit_code'] == 0:
        return 'warning' if row.get('warnings') else 'pass'
    return {1: 'failed or changed', 2: 'unreadable', 3: 'refused'}.get(row['exit_code'], 'crashed')


def worst_first(rows: Sequence[Row]) -> list[Row]:
    """Return rows without an answer, then the others by their residuals."""
    return sorted(rows, key=lambda row: (
        -row['exit_code'], -(row.get('residual_rms') or row.get('rms') or 0.0)))


def worst_answers(rows: Sequence[Row]) -> list[Row]:
    """Return the answers that should be opened first."""
    return worst_first([row for row in rows if row['exit_code'] in (0, 1)])[:WORST]


def write_table(rows: Sequence[Row], out: Path) -> None:
    """Write results.csv and report.html; raises UnwritableError."""
    ordered = sorted(rows, key=lambda row: str(row['label']))
    names = list(dict.fromkeys(name for row in ordered for name in row))
    write_whole(out / 'results.csv',
                csv_text(names, ([row.get(name) for name in names] for row in ordered)))
    causes: dict[str, list[Row]] = {}
    for row in worst_first(rows):
        if row.get('cause'):  # the same sentence with other numbers is the same cause
            causes.setdefault(re.sub(r'\d[\d.e+-]*', '', row['cause']), []).append(row)
    write_whole(out / 'report.html', page(
        'batch.html', rows=worst_first(rows), answers=worst_answers(rows),
        cells=cells_of(rows, out),
        figures=[figure for figure in FIGURES
                 if any(row.get(figure[0]) is not None for row in rows)],
        result=result_of, most=WORST,
        causes=sorted(causes.values(), key=len, reverse=True),
        counts=Counter(map(result_of, rows)).most_common(),
        target=lambda row: next((f'{row["label"]}/{name}' for name in ('report.html', 'output.txt')
                               if (out / row['label'] / name).exists()), '')))


def cells_of(rows: Sequence[Row], out: Path) -> list[tuple[str, int, str]]:
    """Return name, number of answers and trend in words of each cell: the label's folders."""
    cells: dict[str, list[Row]] = {}
    for row in sorted(rows, key=lambda row: (row.get('stamp', 0), row['label'])):
        if row['exit_code'] in (0, 1):
            cells.setdefault(row['label'].rpartition('/')[0], []).append(row)
    found = []
    for name, cell in sorted(cells.items()):
        if len(cell) < 2:
            continue
        if cell[0]['verb'] == 'solve':
            files = [out / row['label'] / 'calibration.yaml' for row in cell]
            try:
                said = trend.since_when(trend.trend(out / name, files=files)[0])
            except DataError as error:
                said = str(error)
        else:
            first = str(cell[0].get('verdict', ''))
            other = next((row for row in cell if row.get('verdict', '') != first), None)
            said = f'{first}; {other["verdict"]} since {other["label"]}' if other else (
                f'{first} in all')
        found.append((name, len(cell), said))
    return found
