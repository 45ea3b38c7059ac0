"""The verb that runs another verb on many recordings."""
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
import io
from pathlib import Path
import sys
from typing import Annotated, Any, TYPE_CHECKING

from handeye_ros.cli.common import app, Assignments, ConfigFile, configuration
from handeye_ros.errors import UnwritableError
import typer

if TYPE_CHECKING:
    from handeye_ros.batch.jobs import Job, Row

VERBS = ('solve', 'verify', 'check', 'compare')


def run_verb(words: list[str]) -> int:
    """Run `handeye WORDS` in this process, and return its exit code."""
    from importlib import import_module
    command = import_module('handeye_ros.cli').command()  # a worker has not imported the verbs
    try:
        command(words, prog_name='handeye')
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(bool(end.code))
    return 0


@contextmanager
def _watched(total: int) -> Iterator[Callable[['Row'], None]]:
    """Show on a terminal the results so far and the time left; yields a function of a row."""
    if not sys.stderr.isatty():
        yield lambda row: None
        return
    from collections import deque

    from handeye_ros.batch.report import result_of
    from rich.console import Console, Group
    from rich.live import Live
    from rich.progress import MofNCompleteColumn, Progress
    from rich.table import Table
    progress = Progress(*Progress.get_default_columns(), MofNCompleteColumn())
    task, counts, latest = progress.add_task('jobs', total=total), Counter[str](), deque['Row'](
        maxlen=8)
    with Live(progress, console=Console(stderr=True), transient=True) as live:
        def add_row(row: 'Row') -> None:
            latest.append(row)
            counts[result_of(row)] += 1
            table = Table('recording', 'result', 's', 'cause')
            for recent in latest:
                table.add_row(recent['label'], result_of(recent), str(recent.get('seconds', '')),
                              recent.get('cause', '')[:80])
            progress.advance(task)
            live.update(Group(table, ', '.join(f'{n} {name}' for name, n in counts.items()),
                              progress))
        yield add_row


def _run_quietly(words: list[str]) -> int:
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        return run_verb(words)


def _reported(client: Any, rows: 'list[Row]', out: Path) -> None:
    """Write the page, with the trend of each cell and the reports of the worst calibrations."""
    from handeye_ros.batch.report import cell_of, cells_of, worst_answers, write_report
    cells = cells_of(rows)
    trends = client.map(cell_of, [*cells], [*cells.values()], out=out, pure=False)
    pages = client.map(_run_quietly, [
        ['report', str(out / row['label'])] for row in worst_answers(rows)
        if row['verb'] == 'solve'], pure=False)
    client.gather(pages, errors='skip')
    write_report(rows, client.gather(trends, errors='skip'), out / 'report.html')


def _run_all(client: Any, jobs: 'list[Job]', out: Path) -> str:
    """Run the jobs, write the table and the page; return a summary."""
    from handeye_ros.batch.report import result_of
    from handeye_ros.batch.run import rows_of, write_rows
    rows = []
    with _watched(len(jobs)) as watched:
        for row in rows_of(client, jobs, out, run_verb):
            rows.append(row)
            watched(row)
    write_rows(rows, out)
    _reported(client, rows, out)
    counts = Counter(map(result_of, rows)).items()
    return (f'{len(rows)} recordings: {", ".join(f"{count} {name}" for name, count in counts)}; '
            f'{sum(row["computed"] for row in rows)} computed, the others unchanged; wrote {out}')


@app.command()
def batch(
    sources: Annotated[list[str], typer.Argument(
        metavar='SOURCE...', help='Bags, folders of bags (paths, or URLs that fsspec opens), '
        'or CSV or YAML lists of them (bag, label, config, settings, args).')],
    out: Annotated[Path, typer.Option(metavar='FOLDER', help='Where the results are put.')],
    verb: Annotated[str, typer.Option(help='solve, verify, check or compare.')] = 'solve',
    args: Annotated[str, typer.Option(
        help='Words of the verb before the bag, such as "sphere --calibration FILE".')] = '',
    config: ConfigFile = None,
    assignments: Assignments = [],  # noqa: B006 - never changed
    scheduler: Annotated[str, typer.Option(
        help='local: one process for each core of this machine; or the address of a Dask '
        'scheduler, such as tcp://host:8786.')] = 'local',
    memory: Annotated[str, typer.Option(
        help='What each local worker may use, such as 2GB; auto: its part of this machine.'
        )] = 'auto',
    dashboard: Annotated[bool, typer.Option(
        '--dashboard', help='Show the page of Dask at port 8787 (local).')] = False,
) -> None:
    """Run one verb on many recordings, in parallel; again: only on new or changed ones."""
    from handeye_ros.batch.jobs import Job, LOCKS
    from handeye_ros.batch.run import client_of, jobs_of, words_of
    if verb not in VERBS:
        raise typer.BadParameter(f'{verb!r} is not one of {", ".join(VERBS)}', param_hint='--verb')
    jobs = jobs_of(sources, Job('', '', verb, words_of(args, Path()),
                                str(config.absolute()) if config else '', tuple(assignments)))
    if len({(job.config, job.settings) for job in jobs}) == 1:
        configuration(config, assignments)  # an error in it concerns all jobs
    out = out.absolute()
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / LOCKS).touch()
        with client_of(scheduler, memory=memory, dashboard=dashboard) as client:
            typer.echo(_run_all(client, jobs, out))
    except OSError as error:
        if error.filename is None:
            raise
        raise UnwritableError(error.filename, error.strerror or str(error)) from error
