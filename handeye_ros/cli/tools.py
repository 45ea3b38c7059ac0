# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The other verbs: errors of the arm; many recordings; publish and simulate a recording."""
from collections import Counter
from dataclasses import replace
from enum import StrEnum
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, TYPE_CHECKING

from handeye_ros import __version__
from handeye_ros.cli.common import (
    app,
    Assignments,
    Bag,
    collect_samples,
    ConfigFile,
    configuration,
    file_option,
    folder_option,
    INTERRUPTED_EXIT_CODE,
    is_table,
    progress_bar,
    read_bag_shown,
    show,
    warn,
)
from handeye_ros.errors import count_of, NoRosError, UnknownNameError
import typer

if TYPE_CHECKING:
    from handeye_ros.batch import JobRow

PREFORM_FILE = 'preform.ply'
BatchVerb = StrEnum('BatchVerb', ['solve', 'verify', 'check', 'compare'])  # that batch runs


@app.command()
def kinematics(
    sources: Annotated[list[Path], typer.Argument(metavar='SOURCE...', help=(
        'Bags with profiles and joint values, or sessions, each with the target at another place; '
        'or a table of joint values and measured points (CSV). State the target, as in --set '
        'target.type=sphere.'))],
    urdf: Annotated[Path, file_option(help='The URDF of the robot.')],
    base: Annotated[str, typer.Option(help='Link of its base; default: the root.')] = '',
    flange: Annotated[str, typer.Option(
        help='Link of the sensor; default: tool0, flange, or the last.')] = '',
    config: ConfigFile = None,
    assignments: Assignments = [],
    out: Annotated[Path, folder_option(
        help='For corrected.urdf, kinematics.yaml, calibration.yaml.')] = Path('out/kinematics'),
) -> None:
    """Estimate the errors of the arm, with the transform."""
    tables = [*filter(is_table, sources)]
    if tables and len(sources) > 1:
        raise typer.BadParameter('give one table only; its column "target" names the points')
    if len({path.resolve() for path in sources}) < len(sources):
        raise typer.BadParameter('give each source once: it would count twice')
    settings = configuration(config, assignments)
    from handeye_ros.arm import read_urdf
    from handeye_ros.bags.session_files import is_session, read_session
    from handeye_ros.results.file_values import input_provenance
    from handeye_ros.robot.arm_answer import table
    from handeye_ros.robot.sources import arm_samples_of, solve_samples, solve_table
    text, arm = read_urdf(urdf, base, flange)
    if tables:
        with progress_bar('solving'):
            answer = solve_table(tables[0], arm, settings,
                                 [*map(input_provenance, (*tables, urdf))])
    else:
        measured = []
        for path in sources:
            stored = read_session(path) if is_session(path) else None
            read_with = replace(configuration(
                config, assignments, stored.config if stored else None), kinematics='')
            recording = read_bag_shown(path, read_with, arm)
            measured.append(arm_samples_of(
                stored.session(read_with) if stored else collect_samples(recording, read_with),
                recording, arm, read_with,
                [{'path': str(path.absolute())}] if stored else recording.inputs))
        with progress_bar('solving'):
            answer = solve_samples(measured, arm, [input_provenance(urdf)])
    warn(*answer.warnings)
    show(table(answer))
    typer.echo(answer.save(text, out, settings.save.formats))


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
    from handeye_ros.simulate import FAULTS, FILE_SCENES, SCENARIOS
    from handeye_ros.simulate.artefacts import MEASURING_CELL
    return [*dict.fromkeys([*SCENARIOS, *FILE_SCENES, *FAULTS]), MEASURING_CELL]


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
    with progress_bar('simulating'):
        content = write_simulated(scenario, seed, directory, force)
    typer.echo(f'wrote {directory.absolute()}: {content}')


def write_simulated(name: str, seed: int, folder: Path, force: bool = False) -> str:
    """
    Write the folder of a scenario, of a scene of files or of MEASURING_CELL.

    Returns its content in words. force: whether an existing folder is replaced; without it
    InputError is raised. Raises UnwritableError where the folder cannot be written.
    """
    from handeye_ros.bags import bag_write
    from handeye_ros.output import yaml_text
    from handeye_ros.results.truth import TRUTH_NAME
    from handeye_ros.scanning.cloud import write_cloud
    from handeye_ros.simulate import (
        artefacts,
        FAULTS,
        FILE_SCENES,
        SCENARIOS,
        simulate,
        Simulated,
    )
    import numpy as np
    from numpy.lib.recfunctions import unstructured_to_structured
    rng = np.random.default_rng(seed)
    origin = {'made_by': f'handeye_ros {__version__}: handeye simulate {name} --seed {seed}',
              'scenario': name, 'seed': seed}
    if name == artefacts.MEASURING_CELL:
        recordings, true_values = artefacts.measuring_cell(rng)
        texts = {TRUTH_NAME: yaml_text({**origin, **true_values})}

        def write_recordings(new_folder: Path) -> None:
            new_folder.mkdir()
            for part, messages in recordings.items():
                bag_write.write(new_folder / part, messages.profiles, messages.poses, texts=texts)
            cloud = artefacts.preform_cloud(np.random.default_rng(seed))
            rows = unstructured_to_structured(cloud.points,
                                              np.dtype([(axis, '<f4') for axis in 'xyz']))
            write_cloud(new_folder / PREFORM_FILE, [rows], 'frame base, metres')

        bag_write.write_folder(folder, texts, write_recordings, force)
        return ', '.join([*recordings, PREFORM_FILE])
    scenario = SCENARIOS.get(name) or FAULTS.get(name)
    simulated = simulate(scenario, rng) if scenario else FILE_SCENES[name](rng)
    texts = {**simulated.tables, TRUTH_NAME: yaml_text({**origin, **simulated.true_values})}
    if not simulated.profiles:
        bag_write.write_folder(folder, texts, force=force)
        return ', '.join(simulated.tables)
    bag_write.write(folder, simulated.profiles, simulated.poses, texts=texts, force=force,
                    joints=simulated.joints if isinstance(simulated, Simulated) else ())
    return ', '.join([f'{len(simulated.profiles)} profiles', f'{len(simulated.poses)} poses',
                      *simulated.tables])
