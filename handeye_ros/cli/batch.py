"""The verb that takes many recordings through another verb."""
from pathlib import Path
from typing import Annotated

from handeye_ros.cli.app import app
from handeye_ros.cli.common import advancing, Assignments, ConfigFile
import typer

VERBS = ('solve', 'verify', 'check', 'compare')


def run_verb(words: list[str]) -> int:
    """Run `handeye WORDS` in this process, and return its exit code."""
    from importlib import import_module
    import_module('handeye_ros.cli.verbs')  # a worker has none yet
    try:
        app(words, prog_name='handeye')
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(bool(end.code))
    return 0


@app.command()
def batch(
    sources: Annotated[list[Path], typer.Argument(
        metavar='SOURCE...', help='Bags, folders of bags, or CSV or YAML lists of them (bag, '
        'label, config, settings, args).')],
    out: Annotated[Path, typer.Option(metavar='FOLDER', help='Where the results are put.')],
    verb: Annotated[str, typer.Option(help='solve, verify, check or compare.')] = 'solve',
    args: Annotated[str, typer.Option(
        help='Words of the verb before the bag, such as "sphere --calibration FILE".')] = '',
    config: ConfigFile = None,
    assignments: Assignments = [],  # noqa: B006 - never changed
    scheduler: Annotated[str, typer.Option(
        help='local: one process for each core of this machine; or the address of a Dask '
        'scheduler, such as tcp://host:8786.')] = 'local',
    dashboard: Annotated[bool, typer.Option(
        '--dashboard', help='Show the page of Dask at port 8787 (local).')] = False,
) -> None:
    """Take many recordings through one verb, in parallel; again: only what is new or changed."""
    import shlex

    from handeye_ros.batch.jobs import Job, jobs_of
    from handeye_ros.batch.report import result_of, write_report
    from handeye_ros.batch.run import client_of, rows_of, write_rows
    if verb not in VERBS:
        raise typer.BadParameter(f'{verb!r} is not one of {", ".join(VERBS)}', param_hint='--verb')
    jobs = jobs_of(sources, Job('', '', verb, tuple(shlex.split(args)),
                                str(config.absolute()) if config else '', tuple(assignments)))
    out = out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    with client_of(scheduler, dashboard) as client, advancing(f'{len(jobs)} jobs') as progress:
        for row in rows_of(client, jobs, out, run_verb):
            rows.append(row)
            progress(len(rows) / len(jobs))
    write_rows(rows, out)
    write_report(rows, out / 'report.html')
    results = [result_of(row) for row in rows]
    told = ', '.join(f'{results.count(name)} {name}' for name in dict.fromkeys(results))
    typer.echo(f'{len(rows)} recordings: {told}; {sum(row["computed"] for row in rows)} computed, '
               f'the others unchanged; wrote {out}')
