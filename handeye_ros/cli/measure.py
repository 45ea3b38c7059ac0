# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a calibrated robot measures, and whether its calibration still holds."""
from itertools import chain
from pathlib import Path
from typing import Annotated, TYPE_CHECKING

from handeye_ros.cli.common import (
    app,
    Assignments,
    CalibrationFile,
    collect_samples,
    File,
    KinematicsFile,
    MeasureConfig,
    NoPath,
    open_calibration,
    OutFile,
    progress_bar,
    read_bag,
    show,
    stream_recording,
    warn,
    warn_of_frame,
)
import typer

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from handeye_ros.config import Config
    from handeye_ros.data import Calibration, Profile, Reject, Sample
    from handeye_ros.sampling.trajectory import Trajectory
    from handeye_ros.verification.check import Check

NOT_AS_WANTED = 1  # exit code: measured, and not passed, or changed
Bags = Annotated[list[Path], typer.Argument(
    metavar='BAG...', help='Recordings with stops, one of each face or ball, in their order.')]


@app.command()
def verify(
    name: Annotated[str, typer.Argument(
        metavar='ROUTINE', help='line, plane, point, sphere, ball_bar, step, square or tooth.')],
    bags: Bags,
    calibration: CalibrationFile,
    config: MeasureConfig = None,
    assignments: Assignments = [],
    kinematics: KinematicsFile = None,
    out: OutFile = None,
    stations: Annotated[NoPath, File(help='Write a table of the stops (CSV).')] = None,
    protocol: Annotated[NoPath, File(help=(
        'Write a protocol for the file of an inspector (HTML; print it to PDF).'))] = None,
) -> None:
    """
    Measure something known with a calibration.

    The exit code is 0 for a pass, 1 for another verdict, 2 and 3 for none (as of every verb).

    The artefact and the tolerances are keys, such as --set verify.radius=20mm
    --set verify.lengths=[200mm] --set verify.tolerance=0.3mm; docs/measure.md tells which of them
    a routine needs.
    """
    from handeye_ros.output import html_file, write_atomically, yaml_text
    from handeye_ros.results import verification_file
    from handeye_ros.verification import verify as verification
    from handeye_ros.verification.routines import routine_of, settings_for
    from handeye_ros.verification.stations import stations_of, stations_of_passes
    if protocol:
        html_file(protocol)
    routine = routine_of(name)
    opened, settings = open_calibration(calibration, config, assignments, kinematics)
    settings = settings_for(routine, settings, len(bags))
    if routine.in_passes:
        measured, rejects = stations_of_passes(_passes(bags, opened, settings), settings), ()
    else:
        samples, rejects = zip(*(_stops(bag, opened, settings) for bag in bags), strict=True)
        measured = stations_of(routine, samples, opened, settings)
    result = verification.verify(routine, measured, opened, list(chain(*rejects)))
    content = verification.plain_values(result, bags, calibration)
    show(verification_file.table(content))
    if out:
        write_atomically(out, yaml_text(content))
    if stations:
        write_atomically(stations, verification_file.stations_csv(content))
    if protocol:
        write_atomically(protocol, verification_file.protocol(content))
    for sentence in (*filter(None, [result.surface]), result.verdict, *result.reasons):
        typer.echo(sentence)
    if result.verdict != 'pass':
        raise typer.Exit(NOT_AS_WANTED)


def _passes(bags: list[Path], calibration: 'Calibration', config: 'Config'
            ) -> 'Iterator[tuple[Sequence[Profile], Trajectory]]':
    """Yield the profiles and poses of each recording."""
    for bag in bags:
        with stream_recording(bag, config, 'reading the recording', calibration) as opened:
            recording, trajectory, _ = opened
            yield list(recording.returns()), trajectory


def _stops(bag: Path, calibration: 'Calibration', config: 'Config'
           ) -> 'tuple[Sequence[Sample], Sequence[Reject]]':
    """Return what the stops of a recording give."""
    recording = read_bag(bag, config)
    warn_of_frame(recording, calibration)
    session = collect_samples(recording, config)
    _warn_of_own(bag, [sample.stamp for sample in session.samples], calibration)
    return session.samples, session.rejects


def _warn_of_own(bag: Path, stamps: 'Sequence[int]', calibration: 'Calibration') -> None:
    """Warn where samples with some stamps (ns) are those of a calibration."""
    if not {report.stamp for report in calibration.samples if report.used}.isdisjoint(stamps):
        warn(f'{bag} holds stations that the calibration was made of: they agree with it too '
             'well; measure at others')


@app.command()
def check(
    bags: Annotated[list[Path], typer.Argument(
        metavar='BAG...', help='Short recordings of the same target, the oldest first.')],
    against: Annotated[Path, File(help='The calibration.yaml that is to be checked.')],
    config: MeasureConfig = None,
    assignments: Assignments = [],
    kinematics: KinematicsFile = None,
    out: OutFile = None,
) -> None:
    """
    Check whether a calibration still holds.

    The exit code is 0 if nothing has changed, 1 for a change, 2 and 3 if that cannot be told.
    """
    from handeye_ros.output import write_atomically
    from handeye_ros.verification.check import check_recording, plain_values
    import yaml
    calibration, settings = open_calibration(against, config, assignments, kinematics)
    checks: list[tuple[str, Check]] = []
    for bag in bags:
        recording = read_bag(bag, settings)
        warn_of_frame(recording, calibration)
        with progress_bar('comparing'):
            result = check_recording(recording.profiles, recording.poses, calibration, settings)
        _warn_of_own(bag, [result.stamp], calibration)
        checks.append((str(bag), result))
        typer.echo(f'{bag} ({result.stations} stations): {result.verdict.upper()}: '
                   f'{result.sentence}')
    changed = [name for name, result in checks if result.verdict != 'unchanged']
    if changed and len(checks) > 1:
        typer.echo(f'since {changed[0]}')
    if out:
        write_atomically(out, yaml.safe_dump(plain_values(checks, str(against)), sort_keys=False))
    if changed:
        raise typer.Exit(NOT_AS_WANTED)


@app.command()
def trend(
    folder: Annotated[Path, typer.Argument(
        metavar='DIR', help='The folder below which all calibration.yaml are taken.')],
    against: Annotated[NoPath, File(
        help='The calibration that the others are compared with; default: the oldest.')] = None,
    csv: Annotated[NoPath, File(help='Write the calibrations as CSV.')] = None,
) -> None:
    """Show the trend of the calibrations below a folder."""
    from handeye_ros import trend as trends
    from handeye_ros.output import write_atomically
    from handeye_ros.results.calibration_file import read_calibration
    entries, warnings = trends.trend(folder, read_calibration(against) if against else None)
    warn(*warnings)
    show(trends.table(entries))
    typer.echo(trends.since_when(entries))
    if csv:
        write_atomically(csv, trends.csv_text(entries))
        typer.echo(f'wrote {csv.absolute()}')
