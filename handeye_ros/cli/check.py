"""The verb that tells whether a calibration still holds."""
from pathlib import Path
from typing import Annotated, TYPE_CHECKING

from handeye_ros.cli.app import app
from handeye_ros.cli.common import (
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
Bags = Annotated[list[Path], typer.Argument(
    metavar='BAG...', help='Short recordings of the same target, the oldest first.')]
Against = Annotated[Path, typer.Option(
    metavar='FILE', help='The calibration.yaml that is to be checked.')]
Out = Annotated[NoPath, typer.Option(metavar='FILE', help='Write the checks as YAML too.')]


@app.command()
def check(
    bags: Bags,
    against: Against,
    config: MeasureConfig = None,
    assignments: Assignments = [],  # noqa: B006 - never changed
    kinematics: KinematicsFile = None,
    out: Out = None,
) -> None:
    """Check whether a calibration still holds: exit code 0 only where nothing changed, 1 if so."""
    from handeye_ros.output import write_whole
    from handeye_ros.verification import check as checking
    import yaml
    calibration, settings = calibrated(against, config,
                                       with_kinematics(assignments, kinematics))
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
    if changed:
        raise typer.Exit(CHANGED)


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
