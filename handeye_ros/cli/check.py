"""The verbs that check a calibration, and show the trend of several."""
from pathlib import Path
from typing import Annotated, Optional, TYPE_CHECKING

from handeye_ros.cli.common import (
    app,
    Assignments,
    doing,
    KinematicsFile,
    NoPath,
    read_bag,
    show,
    warn,
    with_kinematics,
)
from handeye_ros.cli.scan import calibrated, MeasureConfig
import typer

if TYPE_CHECKING:
    from handeye_ros.config import Config
    from handeye_ros.data import Calibration
    from handeye_ros.verification.check import Check

CHANGED = 1  # exit code: a recording was checked, and something has changed
SomeBags = Annotated[Optional[list[Path]], typer.Argument(  # noqa: UP045 - see common.py
    metavar='[BAG]...', help='Short recordings of the same target, the oldest first.')]
Against = Annotated[NoPath, typer.Option(
    metavar='FILE', help='The calibration.yaml that is to be checked.')]
Folder = Annotated[NoPath, typer.Option(
    metavar='DIR', help='Show the trend of the calibrations below this folder.')]
Picture = Annotated[NoPath, typer.Option(
    metavar='FILE', help='Draw the trend of the folder (needs matplotlib).')]
Csv = Annotated[NoPath, typer.Option(metavar='FILE', help='Write the trend as CSV.')]
Out = Annotated[NoPath, typer.Option(metavar='FILE', help='Write the checks as YAML too.')]


@app.command()
def check(
    bags: SomeBags = None,
    against: Against = None,
    config: MeasureConfig = None,
    assignments: Assignments = [],  # noqa: B006 - never changed
    kinematics: KinematicsFile = None,
    folder: Folder = None,
    picture: Picture = None,
    csv: Csv = None,
    out: Out = None,
) -> None:
    """Check whether a calibration still holds: exit code 0 only if nothing changed, else 1."""
    from handeye_ros.errors import InputError
    if not (bags and against or folder):
        raise InputError('nothing to check: give "handeye check BAG... --against '
                         'calibration.yaml", or --folder DIR for the trend of many calibrations')
    assignments = with_kinematics(assignments, kinematics)
    changed = (_check_bags(bags, against, config, assignments, out) if bags and against
               else False)
    if folder:
        trend(folder, against, picture, csv)
    if changed:
        raise typer.Exit(CHANGED)


def _check_bags(bags: list[Path], against: Path, config: Path | None, assignments: list[str],
                out: Path | None) -> bool:
    """Return whether a recording shows a change."""
    from handeye_ros.output import write_whole
    from handeye_ros.verification import check as checking
    import yaml
    calibration, settings = calibrated(against, config, assignments)
    checks: list[tuple[str, Check]] = []
    for bag in bags:
        result = _checked(bag, calibration, settings)
        checks.append((str(bag), result))
        typer.echo(f'{bag} ({result.stations} stations): {result.verdict.upper()}: '
                   f'{result.sentence}')
    changed = [name for name, result in checks if result.verdict != 'unchanged']
    if changed and len(checks) > 1:
        typer.echo(f'since {changed[0]}')
    if out:
        write_whole(out, yaml.safe_dump(checking.values(checks, str(against)), sort_keys=False))
    return bool(changed)


def _checked(bag: Path, calibration: 'Calibration', settings: 'Config') -> 'Check':
    """Return the check by a recording: by its stops, or by a sweep without stops."""
    from dataclasses import replace

    from handeye_ros import pipeline
    from handeye_ros.sampling.errors import NoStationsError
    from handeye_ros.verification import check
    recording = read_bag(bag, settings)
    with doing('finding the stations'):
        try:
            session = pipeline.gather(recording.profiles, recording.poses, settings)
        except NoStationsError:
            if not calibration.time_offset:
                raise
            settings = replace(settings, sampling=replace(settings.sampling, mode='moving'))
            session = pipeline.gather(recording.profiles, recording.poses, settings)
    reason = next((reject.reason for reject in session.rejects), '')
    if not settings.sampling.moving:
        return check.check(session.samples, calibration, settings, reason)
    solution, used, _ = pipeline.solved(session.samples, session.rejects,
                                        session.with_base(settings), session.frame_id)
    result = check.check(check.some_of_sweep(used), calibration, settings, reason)
    offset = solution.time_offset
    return check.with_offset(result, offset, calibration) if offset else result


TrendFolder = Annotated[Path, typer.Argument(
    metavar='DIR', help='The folder below which all calibration.yaml are taken.')]
TrendAgainst = Annotated[NoPath, typer.Option(
    metavar='FILE', help='The calibration that the others are compared with; default: the '
    'oldest.')]
TrendPicture = Annotated[NoPath, typer.Option(metavar='FILE', help='Draw it (needs matplotlib).')]
TrendCsv = Annotated[NoPath, typer.Option(metavar='FILE', help='Write the calibrations as CSV.')]


@app.command()
def trend(folder: TrendFolder, against: TrendAgainst = None, picture: TrendPicture = None,
          csv: TrendCsv = None) -> None:
    """Show the trend of the calibrations below a folder."""
    from handeye_ros.batch import trend as trends
    from handeye_ros.output import write_whole
    from handeye_ros.results.calibration_file import read_calibration
    entries, warnings = trends.trend(folder, read_calibration(against) if against else None)
    for warning in warnings:
        warn(warning)
    show(trends.table(entries))
    typer.echo(trends.since_when(entries))
    if csv:
        write_whole(csv, trends.csv_text(entries))
        typer.echo(f'wrote {csv.absolute()}')
    if picture:
        trends.draw(entries, picture)
        typer.echo(f'wrote {picture.absolute()}')
