"""The verb that tells whether a calibration still holds, and how several went through time."""
from pathlib import Path
from typing import Annotated, Optional, TYPE_CHECKING

from handeye_ros.cli.common import (
    app,
    Assignments,
    doing,
    KinematicsFile,
    NoPath,
    read_bag,
    with_kinematics,
)
from handeye_ros.cli.scan import calibrated, MeasureConfig
import typer

if TYPE_CHECKING:
    from handeye_ros.config import Config
    from handeye_ros.data import Calibration
    from handeye_ros.verification.check import Check

CHANGED = 1  # exit code: a recording was checked, and something is not as it was
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
    """Check whether a calibration still holds: exit code 0 only where nothing changed, 1 if so."""
    from handeye_ros.verification.errors import NothingToCheckError
    if not (bags and against or folder):
        raise NothingToCheckError
    assignments = with_kinematics(assignments, kinematics)
    changed = (_check_bags(bags, against, config, assignments, out) if bags and against
               else False)
    if folder:
        from handeye_ros.cli.trend import trend
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
        found = _checked(bag, calibration, settings)
        checks.append((str(bag), found))
        typer.echo(f'{bag} ({found.stations} stations): {found.verdict.upper()}: '
                   f'{found.sentence}')
    changed = [name for name, found in checks if found.verdict != 'unchanged']
    if changed and len(checks) > 1:
        typer.echo(f'since {changed[0]}')
    if out:
        write_whole(out, yaml.safe_dump(checking.values(checks, str(against)), sort_keys=False))
    return bool(changed)


def _checked(bag: Path, calibration: 'Calibration', settings: 'Config') -> 'Check':
    """Return what a recording says: by its stops, or by a sweep where it has none."""
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
    now, used, _ = pipeline.solved(session.samples, session.rejects, session.with_base(settings),
                                   session.frame_id)
    found = check.check(check.some_of_sweep(used), calibration, settings, reason)
    return check.with_offset(found, now.time_offset, calibration) if now.time_offset else found
