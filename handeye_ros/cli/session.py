"""The verbs around a session: start the node, show its samples, export and report its answer."""
from importlib.util import find_spec
import os
from pathlib import Path
import sys
from typing import Annotated, TYPE_CHECKING

from handeye_ros.cli.common import (
    app,
    Assignments,
    ConfigFile,
    configuration,
    doing,
    NoPath,
    read_bag,
    show,
    stored_session,
)
from handeye_ros.config import SAVE_FORMATS
from handeye_ros.errors import NoRosError
import typer

if TYPE_CHECKING:
    from handeye_ros.config import Config
    from handeye_ros.sampling.session import Session
    from rich.table import Table

Saved = Annotated[Path, typer.Argument(
    metavar='CALIBRATION', help='A calibration.yaml, or the folder that holds it.')]


@app.command()
def calibrate(
    resume: Annotated[bool, typer.Option(
        '--resume', help='Continue the last session; the default is a new one.')] = False,
    config: ConfigFile = None,
    assignments: Assignments = [],  # noqa: B006 - never changed
) -> None:
    """Start the node that takes samples at the cell (needs ROS)."""
    configuration(config, assignments)  # so that a mistake is reported at once
    if find_spec('rclpy') is None:
        raise NoRosError('calibrate', 'rclpy')
    arguments = ['--params-file', str(config)] if config else []
    for text in [*assignments, *(['session=last'] if resume else [])]:
        key, _, value = text.partition('=')
        arguments += ['-p', f'{key.strip()}:={value}']
    command = [sys.executable, '-m', 'handeye_ros.node']
    os.execv(sys.executable, [*command, *(['--ros-args', *arguments] if arguments else [])])


@app.command()
def samples(
    path: Annotated[Path, typer.Argument(metavar='SESSION', help=(
        'The folder of a session, or a bag.'))],
    config: ConfigFile = None,
    assignments: Assignments = [],  # noqa: B006 - never changed
) -> None:
    """Show the samples of a session, and how well each agrees with the others."""
    from handeye_ros.checks.review import review
    from handeye_ros.errors import DataError
    stored = stored_session(path)
    settings = configuration(config, assignments, stored.config if stored else None)
    with doing('finding the samples'):
        session = stored.session(settings) if stored else _gathered(path, settings)
    outcomes = [outcome for outcome in session.outcomes if outcome.sample]
    included = [not session.excludes(outcome) for outcome in outcomes]
    agreements: dict[int, tuple[float, float, bool]] = {}
    try:
        reviewed = review([o.sample for o in outcomes if o.sample], included, settings)
    except DataError as error:
        typer.echo(f'no residuals yet: {error}', err=True)
    else:
        agreements = {o.number: (a.residual, a.left_out, a.used) for o, a in
                      zip(outcomes, reviewed.agreements, strict=True) if a}
    show(_table(session, agreements))


def _gathered(path: Path, settings: 'Config') -> 'Session':
    from handeye_ros import pipeline
    recording = read_bag(path, settings)
    return pipeline.gather(recording.profiles, recording.poses, settings)


def _table(session: 'Session', agreements: dict[int, tuple[float, float, bool]]) -> 'Table':
    """Return the table of the samples, the largest left-out residuals first."""
    from handeye_ros.checks.review import sample_summary
    from rich import box
    from rich.table import Table
    columns = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for name in ('number', 'residual', 'left out'):
        columns.add_column(name, justify='right')
    columns.add_column('')
    columns.add_column('')
    for outcome in sorted(session.outcomes, key=lambda o: (
            -agreements.get(o.number, (0.0, -1.0))[1], o.number)):
        residual, left_out, used = agreements.get(outcome.number, (None, None, True))
        state = 'left out' if session.excludes(outcome) else '' if used else 'not believed'
        columns.add_row(
            str(outcome.number), *('' if value is None else f'{value * 1e3:.3f} mm'
                                   for value in (residual, left_out)),
            'no sample' if outcome.sample is None else state, sample_summary(outcome.result))
    return columns


@app.command()
def export(
    path: Saved,
    name: Annotated[str, typer.Option(
        '--format', autocompletion=lambda: list(SAVE_FORMATS),
        help=f'One of {", ".join(SAVE_FORMATS)}.')],
    out: Annotated[NoPath, typer.Option(metavar='FILE', help=(
        'The file to write, - for the screen; if not given, one beside the calibration.'))] = None,
) -> None:
    """Write a saved calibration for other programs: URDF, launch file, shell line, ..."""
    from handeye_ros.results import exports
    from handeye_ros.results.calibration_file import file_of, read_calibration
    form, file = exports.format_of(name), file_of(path)
    calibration = read_calibration(file)
    if str(out) == '-':
        typer.echo(form.text(calibration), nl=False)
        return
    target = out or file.parent / form.file_name(calibration)
    typer.echo(exports.export(calibration, name, target))


@app.command()
def report(
    path: Saved,
    bag: Annotated[NoPath, typer.Option(
        metavar='BAG', help='The recording; if not given, the one the calibration names.')] = None,
    out: Annotated[NoPath, typer.Option(
        metavar='FILE', help='If not given, report.html beside the calibration.')] = None,
    verification: Annotated[list[Path], typer.Option(
        metavar='FILE', help='A result of "handeye verify --out" to show too; may be repeated.'
    )] = [],  # noqa: B006 - never changed
) -> None:
    """Show a saved calibration or verification, and its evidence, in one HTML file."""
    from handeye_ros.evidence import evidence
    from handeye_ros.output import write_whole
    from handeye_ros.results import exports, pages
    from handeye_ros.results.calibration_file import file_of, read_calibration
    from handeye_ros.results.verification_file import content_of as verification_in
    from handeye_ros.results.verification_file import read
    if path.is_file() and (values := verification_in(path)):
        html = (out or path.with_suffix('.html')).absolute()
        write_whole(html, pages.protocol(values))
        typer.echo(f'wrote {html}')
        return
    file, verified = file_of(path), [read(one) for one in verification]
    calibration = read_calibration(file)
    with doing('finding the stops'):
        shown = evidence(calibration, bag)
    with doing('writing the report'):
        written = pages.write(
            calibration, shown, out or file.parent / exports.REPORT, verified)
    typer.echo(f'wrote {written}')
