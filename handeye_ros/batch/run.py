"""Runs jobs on Dask workers; rows are written as they arrive."""
from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
import csv
from dataclasses import replace
from functools import partial
import io
from itertools import islice
import os
from pathlib import Path, PurePosixPath
import shlex
from typing import Any

from handeye_ros.batch.errors import (
    BadMemoryError,
    JobListError,
    NoDaskError,
    NoJobsError,
    NoSchedulerError,
)
from handeye_ros.batch.jobs import CRASHED, files_below, is_remote, Job, Row, run, Verb
import yaml

BAGS = ('.mcap', '.db3')
LISTS = ('.csv', '.yaml', '.yml')
COLUMNS = {'bag', 'label', 'config', 'settings', 'args'}
AHEAD = 1000  # unfinished jobs that the scheduler holds at most
LOCAL = {  # settings of Dask on this machine
    # a job that has ended two workers is tried by itself
    'distributed.scheduler.allowed-failures': 1,
    # the profiler stores call stacks: half a megabyte for each job
    'distributed.worker.profile.enabled': False,
    # with Dask's 64 kB memory is released and requested again: 11,000 page faults a job, not 500
    'distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_': 2**27,
    # its default checks of the event loops, 50 a second, take 3 % of two cores
    'distributed.admin.tick.interval': '1s',
    'distributed.admin.system-monitor.interval': '5s',
    # the client handles ctrl-C and ends the workers
    'distributed.worker.preload': ['import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)']}


def jobs_of(sources: Sequence[str], base: Job) -> list[Job]:
    """
    Return the jobs of bags, folders of bags, and CSV or YAML lists; base: the common command.

    Raises JobListError, NoJobsError.
    """
    jobs: list[Job] = []
    for source in sources:
        if source.endswith(LISTS) and Path(source).is_file():
            jobs += _listed(Path(source), base)
        else:
            jobs += [replace(base, bag=bag, label=label)
                     for bag, label in _bags_in(source, several=len(sources) > 1)]
    if not jobs:
        raise NoJobsError(' '.join(sources))
    counts: dict[str, int] = {}
    unique = []
    for job in jobs:
        counts[job.label] = counts.get(job.label, 0) + 1
        number = counts[job.label]
        unique.append(job if number == 1 else replace(job, label=f'{job.label}-{number}'))
    return unique


def _bags_in(source: str, several: bool) -> Iterator[tuple[str, str]]:
    """Yield the bags at a path or URL, and their names; several: with the folder's name."""
    names = files_below(source)
    if names is None and not is_remote(source) and not Path(source).exists():
        raise NoJobsError(source)
    if names is None or 'metadata.yaml' in names:
        yield _absolute(source), PurePosixPath(source).stem
        return
    files = {PurePosixPath(file) for file in names}
    folders = {file.parent for file in files if file.name == 'metadata.yaml'}
    single = {file for file in files if file.suffix in BAGS and file.parent not in folders}
    for bag in sorted(folders | single):
        name = bag.with_suffix('')
        yield (f'{_absolute(source).rstrip("/")}/{bag}',
               str(PurePosixPath(source).name / name if several else name))


def words_of(text: str, folder: Path) -> tuple[str, ...]:
    """Return the words of a command with absolute paths of its files, for workers."""
    return tuple(str((folder / word).absolute()) if (folder / word).is_file() else word
                 for word in shlex.split(text))


def _absolute(source: str | Path) -> str:
    return str(source) if is_remote(str(source)) else str(Path(source).absolute())


def _listed(path: Path, base: Job) -> Iterable[Job]:
    """Return the jobs of a list, whose paths are relative to it."""
    try:
        text = path.read_text(encoding='utf-8')
        rows = (list(csv.DictReader(io.StringIO(text), skipinitialspace=True))
                if path.suffix == '.csv' else yaml.safe_load(text))
        for row in rows:
            if 'bag' not in row or not COLUMNS.issuperset(row):
                raise JobListError(path, f'it has {", ".join(map(str, row))}')
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
        raise JobListError(path, f'{type(error).__name__}: {error}') from error


@contextmanager
def client_of(scheduler: str, *, workers: int = 0, memory: str = 'auto', dashboard: bool = False
              ) -> Iterator[Any]:
    """
    Give a Dask client: of a cluster on this machine (`local`), or of an existing one.

    workers, memory: of this machine, 0: one for each core; the memory that each may use.
    Raises NoDaskError, NoSchedulerError, BadMemoryError.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise NoDaskError('distributed') from error
    if scheduler == 'local':
        try:
            dask.utils.parse_bytes(0 if memory == 'auto' else memory)
        except ValueError as error:
            raise BadMemoryError(memory) from error
        with dask.config.set(LOCAL), \
                LocalCluster(n_workers=workers or len(os.sched_getaffinity(0)),
                             threads_per_worker=1, memory_limit=memory, silence_logs=50,
                             dashboard_address=f'127.0.0.1:{8787 if dashboard else 0}'
                             ) as cluster, Client(cluster) as client:
            yield client
        return
    try:
        client = Client(scheduler, timeout=5)
    except (OSError, ValueError) as error:
        raise NoSchedulerError(scheduler) from error
    with client:
        yield client


def rows_of(client: Any, jobs: Sequence[Job], out: Path, verb: Verb) -> Iterator[Row]:
    """Yield the row of each job when it is done; a killed worker only costs its own job."""
    from distributed import as_completed
    waiting = iter(jobs)
    submit: Callable[..., list[Any]] = partial(client.map, run, out=out, verb=verb, pure=False)
    running: dict[Any, Job] = {}
    done, lost = as_completed(with_results=True, raise_errors=False), []

    def fill() -> None:
        if len(running) <= AHEAD // 2 and (new := list(islice(waiting, AHEAD - len(running)))):
            futures = submit(new)  # one call for many costs the scheduler less
            running.update(zip(futures, new, strict=True))
            done.update(futures)

    fill()
    for batch in done.batches():
        for future, result in batch:
            job = running.pop(future)
            if type(future.exception()).__name__ == 'KilledWorker':
                lost.append(job)
            else:
                yield _row(job, future, result)
        fill()
    for job in lost:  # alone: another job may have ended the worker
        future, = submit([job])
        yield _row(job, future, None if future.exception() else future.result())


def _row(job: Job, future: Any, result: Any) -> Row:
    """Return the row of a finished job."""
    error = future.exception()
    return result if error is None else {
        'label': job.label, 'bag': job.bag, 'verb': job.verb, 'exit_code': CRASHED,
        'cause': f'{type(error).__name__}: {error}', 'computed': True}


def write_rows(rows: Sequence[Row], folder: Path) -> None:
    """Write results.csv and results.parquet; raises NoDaskError."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise NoDaskError('pyarrow') from error
    names = list(dict.fromkeys(name for row in rows for name in row))
    full = [{name: row.get(name) for name in names}
            for row in sorted(rows, key=lambda row: str(row['label']))]
    parquet.write_table(pyarrow.Table.from_pylist(full), folder / 'results.parquet.part')
    with (folder / 'results.csv.part').open('w', newline='', encoding='utf-8') as stream:
        writer = csv.DictWriter(stream, names)
        writer.writeheader()
        writer.writerows(full)
    for name in ('results.csv', 'results.parquet'):
        (folder / f'{name}.part').replace(folder / name)
