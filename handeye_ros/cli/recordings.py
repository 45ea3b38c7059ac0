# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The verbs about recordings: one command on many of them; publish one, and simulate one."""
from collections import Counter
from enum import StrEnum
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, TYPE_CHECKING

from handeye_ros.cli.common import (
    app,
    Assignments,
    Bag,
    ConfigFile,
    configuration,
    INTERRUPTED_EXIT_CODE,
    progress_bar,
)
from handeye_ros.errors import NoRosError, UnknownNameError
from handeye_ros.words import count_of
import typer

if TYPE_CHECKING:
    from handeye_ros.batch import JobRow

BatchVerb = StrEnum('BatchVerb', ['solve', 'verify', 'check', 'compare'])  # that batch runs


def run_verb(arguments: list[str]) -> int:
    """Run `handeye ARGUMENTS` in this process, and return its exit code."""
    command = import_module('handeye_ros.cli').command()  # a worker has not imported the verbs
    try:
        command(arguments, prog_name='handeye')
    except SystemExit as end:
        return int(end.code or 0)
    return 0


@app.command()
def batch(
    ctx: typer.Context,
    sources: Annotated[list[str], typer.Argument(metavar='SOURCE...', help=(
        'Bags, folders of bags, or CSV lists (bag, label, config, settings, args).'))],
    out: Annotated[Path, typer.Option(metavar='FOLDER', help='Where the results are put.')],
    verb: Annotated[BatchVerb, typer.Option(help='The command to run.')] = BatchVerb.solve,
    args: Annotated[str, typer.Option(
        help='Its arguments before the bag, such as "sphere --calibration FILE".')] = '',
    config: ConfigFile = None,
    assignments: Assignments = [],
    scheduler: Annotated[str, typer.Option(
        help='local: all cores of this machine; or a Dask scheduler: tcp://host:8786.')] = 'local',
) -> None:
    """Run one command on many recordings, again on new ones."""
    from handeye_ros import batch as batches
    from handeye_ros.output import write_errors_for
    arguments = batches.arguments_of(args, config, assignments)
    jobs = batches.jobs_of(sources, verb.value, arguments)
    out = out.absolute()
    if all(job.arguments == arguments for job in jobs):  # an error in them concerns all jobs
        configuration(config, assignments)
        command: Any = ctx.find_root().command
        command.commands[verb].make_context(verb, jobs[0].command(out)[1:], parent=ctx.parent)
    rows: list[JobRow] = []
    with write_errors_for(out):
        out.mkdir(parents=True, exist_ok=True)
    try:
        with progress_bar(count_of(len(jobs), 'recording')) as progress:
            for row in batches.job_rows(jobs, out, run_verb, scheduler):
                rows.append(row)
                progress(len(rows) / len(jobs))
        batches.write_table(rows, out)
    except KeyboardInterrupt:
        done_count = sum(batches.earlier_row(job, out) is not None for job in jobs)
        typer.echo(f'{done_count} of {len(jobs)} done; run again to continue', err=True)
        raise typer.Exit(INTERRUPTED_EXIT_CODE) from None
    counts = Counter(map(batches.outcome_of, rows)).items()
    computed = sum(row['computed'] for row in rows)
    outcomes = ', '.join(f'{count} {name}' for name, count in counts)
    typer.echo(f'{count_of(len(rows), "recording")}: {outcomes}; {computed} computed, '
               f'{len(rows) - computed} unchanged; wrote {out}')


@app.command()
def replay(
    bag: Bag,
    rate: Annotated[float, typer.Option(help='Speed; 1 is as recorded.')] = 1.0,
) -> None:
    """Publish a recording on its topics (needs ROS)."""
    try:
        import_module('rclpy')  # first: without ROS its message packages are missing too
        from handeye_ros.node.replay import replay as publish
    except ModuleNotFoundError as error:
        raise NoRosError('replay', str(error.name)) from error
    publish(bag, rate)


def _scenarios() -> list[str]:
    """Return the names of all that can be simulated."""
    from handeye_ros.cli.simulated import NAMES
    return NAMES


def _print_scenarios(requested: bool) -> None:
    if requested:
        typer.echo('\n'.join(_scenarios()))
        raise typer.Exit


@app.command()
def simulate(
    scenario: Annotated[str, typer.Argument(help='The name of a scenario; see --list.',
                                            autocompletion=_scenarios)],
    directory: Annotated[Path, typer.Argument(metavar='DIR', help='The folder to make.')],
    seed: Annotated[int, typer.Option(min=0, help='The seed of all random numbers.')] = 0,
    force: Annotated[bool, typer.Option('--force', help='Replace a bag that is there.')] = False,
    listed: Annotated[bool, typer.Option(
        '--list', callback=_print_scenarios, is_eager=True,
        help='Print the names of all scenarios.')] = False,
) -> None:
    """Make a recording with a known answer."""
    if scenario not in _scenarios():
        raise UnknownNameError('scenario', scenario, _scenarios(), 'handeye simulate --list')
    from handeye_ros.cli.simulated import write_simulated
    with progress_bar('simulating'):
        content = write_simulated(scenario, seed, directory, force)
    typer.echo(f'wrote {directory.absolute()}: {content}')
