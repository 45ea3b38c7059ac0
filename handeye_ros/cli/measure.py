# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The verbs that use a calibration: measure something known, see what has moved, scan, seams."""
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime, UTC
import math
from pathlib import Path
from typing import Annotated, Any, Optional, TYPE_CHECKING

from handeye_ros import units
from handeye_ros.cli.common import (
    app,
    Assignments,
    Bag,
    doing,
    gathered,
    KinematicsFile,
    NoPath,
    read_bag,
    show,
    warn,
    with_kinematics,
)
import typer

if TYPE_CHECKING:
    from handeye_ros.config import Config
    from handeye_ros.data import Array, Calibration
    from handeye_ros.scanning.scan import ScanCount
    from handeye_ros.verification.check import Check
    from handeye_ros.verification.routines import Routine
    from handeye_ros.verification.shapes import StationSet
    from handeye_ros.verification.verification import Verification

CalibrationFile = Annotated[Path, typer.Option(
    '--calibration', metavar='FILE', help='The calibration.yaml of this sensor.')]
MeasureConfig = Annotated[NoPath, typer.Option(
    help='A ROS parameter file; without it, the settings that the calibration was made with.')]


def calibrated(file: Path, config: Path | None, assignments: list[str]
               ) -> tuple['Calibration', 'Config']:
    """Return a calibration, and the settings to measure with it."""
    from handeye_ros.config import load, with_assignments
    from handeye_ros.results.calibration_file import read_calibration
    from handeye_ros.results.evidence import use_config
    calibration = read_calibration(file)
    settings = use_config(calibration, load(config) if config else None)
    return calibration, with_assignments(settings, assignments)


NOT_PASSED = 1  # exit code: the verification did not pass
NOWHERE = ('', '', '')  # the typer of Jazzy has no tuple without a value
ANYWHERE = ('', '', '', '')
Name = Annotated[str, typer.Argument(metavar='ROUTINE', help='See docs/measure.md.')]
Bags = Annotated[list[Path], typer.Argument(
    metavar='BAG...', help='Recordings with stops, one of each face or ball, in their order.')]
NoFloat = Optional[float]  # noqa: UP045 - the typer of Jazzy does not know `float | None`
NoText = Optional[str]  # noqa: UP045 - likewise
Lengths = Annotated[list[str], typer.Option(
    '--length', metavar='L', help='Nominal length, or height over the first face, once for each; '
    'of teeth pitch and height (metres, or with a unit: 25mm).')]
Flank = Annotated[NoText, typer.Option(
    metavar='L', help="Horizontal way of a tooth's flank; 0: a quarter of the pitch.")]
Radius = Annotated[NoText, typer.Option(metavar='L', help='Radius of the balls.')]
Reference = Annotated[tuple[str, str, str], typer.Option(
    metavar='X Y Z', help='The point as a tip of the robot touched it (base).')]
Aim = Annotated[NoText, typer.Option(
    metavar='L', help='How exactly the laser was put to the point, 1 sigma.')]
Certificate = Annotated[NoText, typer.Option(
    metavar='U', help='Expanded uncertainty (k = 2) of lengths, radius and reference by the '
    "artefact's certificate.")]
Tolerance = Annotated[NoText, typer.Option(
    metavar='L', help='Largest error of a length (0.3mm, or metres).')]
AngleTolerance = Annotated[NoFloat, typer.Option(
    min=1e-9, help='Largest error of an angle (degrees).')]
USUAL = {'lengths': 2.0, 'radius': 0.5, 'reference': 10.0, 'aim': 0.01, 'flank': 0.1,
         'certificate': 0.01, 'tolerance': 0.01, 'near': 10.0}  # m: larger plain numbers: refused
Near = Annotated[tuple[str, str, str, str], typer.Option(
    metavar='X Y Z R', help='Use only what comes into this ball of the base.')]
VerifyOut = Annotated[NoPath, typer.Option(metavar='FILE', help='Write the result as YAML too.')]
StationsFile = Annotated[NoPath, typer.Option(
    metavar='FILE', help='Write a table of the stops (CSV).')]

Protocol = Annotated[NoPath, typer.Option(
    metavar='FILE', help='Write a protocol for the file of an inspector (HTML; print it to PDF).')]


def keys(options: 'Mapping[str, str | Sequence[str] | None]', angle: float | None
         ) -> 'dict[str, object]':
    """Return keys of the configuration from options, in metres and radians."""
    values: dict[str, object] = {}
    for name, text in options.items():
        option = '--length' if name == 'lengths' else f'--{name}'
        if isinstance(text, str):
            values[f'verify.{name}'] = units.length(text, option, USUAL[name])
        elif text:
            values[f'verify.{name}'] = [units.length(item, option, USUAL[name]) for item in text]
    return values | ({'verify.angle_tolerance': math.radians(angle)} if angle else {})


@app.command()
def verify(
    name: Name,
    bags: Bags,
    calibration: CalibrationFile,
    config: MeasureConfig = None,
    assignments: Assignments = [],  # noqa: B006 - never changed
    kinematics: KinematicsFile = None,
    length: Lengths = [],  # noqa: B006 - never changed
    radius: Radius = None,
    reference: Reference = NOWHERE,
    aim: Aim = None,
    flank: Flank = None,
    certificate: Certificate = None,
    near: Near = ANYWHERE,
    tolerance: Tolerance = None,
    angle_tolerance: AngleTolerance = None,
    out: VerifyOut = None,
    stations: StationsFile = None,
    protocol: Protocol = None,
) -> None:
    """Measure something known with a calibration: exit code 0 only for a pass, 1 otherwise."""
    from handeye_ros.config import with_values
    from handeye_ros.output import html_file, write_whole
    from handeye_ros.results.calibration_file import input_values
    from handeye_ros.verification import verification
    from handeye_ros.verification.routines import routine_of
    routine = routine_of(name)
    answer, settings = calibrated(calibration, config, with_kinematics(assignments, kinematics))
    options = {'lengths': length, 'radius': radius, 'reference': reference if reference[0] else (),
               'aim': aim, 'flank': flank, 'certificate': certificate, 'tolerance': tolerance,
               'near': near if near[0] else ()}
    settings = with_values(settings, keys(options, angle_tolerance), 'the options')
    if protocol:
        html_file(protocol)
    result = _verified(routine, bags, answer, settings)
    result = replace(result, calibration_file=tuple(input_values(calibration).items()),
                     created=datetime.now(UTC).isoformat(timespec='seconds'))
    show(verification.table(result))
    if out:
        write_whole(out, verification.yaml_text(result))
    if stations:
        write_whole(stations, verification.stations_csv(result))
    if protocol:
        from handeye_ros.results import pages
        write_whole(protocol, pages.protocol(verification.values(result)))
    for sentence in (*filter(None, [result.surface]), result.verdict, *result.reasons):
        typer.echo(sentence)
    if result.verdict != 'pass':
        raise typer.Exit(NOT_PASSED)


def _verified(routine: 'Routine', bags: list[Path], calibration: 'Calibration',
              config: 'Config') -> 'Verification':
    from handeye_ros.verification.routines import TEETH
    from handeye_ros.verification.verify import settings_for, stations_of, verify
    settings = settings_for(routine, config, len(bags))
    scanned = routine.target == TEETH
    stations_of_bags, reason = [], ''
    for bag in bags:
        if scanned:
            stations_of_bags.append(_pass(bag, settings))
            continue
        session = gathered(bag, settings)
        used = {report.stamp for report in calibration.samples if report.used}
        if any(sample.stamp in used for sample in session.samples):
            warn(f'{bag} holds stations that the calibration was made of: they agree with it too '
                 'well; measure at others')
        reason = reason or next((reject.reason for reject in session.rejects), '')
        stations_of_bags.append(stations_of(routine, session.samples, calibration, settings))
    result = verify(routine, stations_of_bags, calibration, settings, reason)
    return replace(result, inputs=tuple(map(str, bags)))


def _pass(bag: Path, config: 'Config') -> 'StationSet':
    """Return the points of a scan in one pass."""
    from handeye_ros.bags.bag import flow
    from handeye_ros.sampling.trajectory import track_of
    from handeye_ros.verification.tooth_gauge import stations_of_pass
    with doing('reading the recording'):
        source = flow(bag, config)
        track = track_of(source.poses, config.sampling.max_pose_gap)
        stations = stations_of_pass(list(source.profiles()), track, config)
    for warning in source.warnings:
        warn(warning)
    return stations


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
CheckOut = Annotated[NoPath, typer.Option(metavar='FILE', help='Write the checks as YAML too.')]


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
    out: CheckOut = None,
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
    from handeye_ros import pipeline
    from handeye_ros.errors import DataError
    from handeye_ros.verification import check
    recording = read_bag(bag, settings)
    with doing('finding the stations'):
        try:
            session = pipeline.gather(recording.profiles, recording.poses, settings)
        except DataError as error:
            if error.reason != 'no_stops' or not calibration.time_offset:
                raise
            settings = replace(settings, sampling=replace(settings.sampling, mode='moving'))
            session = pipeline.gather(recording.profiles, recording.poses, settings)
    reason = next((reject.reason for reject in session.rejects), '')
    if not settings.sampling.moving:
        return check.check(session.samples, calibration, settings, reason)
    swept, used, _ = pipeline.solved(session.samples, session.rejects,
                                     session.with_base(settings), session.frame_id)
    result = check.check(check.some_of_sweep(used), calibration, settings, reason)
    offset = swept.time_offset
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
    from handeye_ros import trend as trends
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


@app.command()
def scan(
    bag: Bag,
    calibration: CalibrationFile,
    out: Annotated[Path, typer.Option(metavar='CLOUD', help='The file to write: .ply or .pcd.')],
    config: MeasureConfig = None,
    assignments: Assignments = [],  # noqa: B006 - never changed
    kinematics: KinematicsFile = None,
    voxel: Annotated[str, typer.Option(
        metavar='L', help='Keep one point of each cube with this edge (0.2mm, or metres).')
    ] = '0',
    limits: Annotated[tuple[str, str], typer.Option(
        '--range', metavar='NEAR FAR', help='Keep points in this range of the sensor.')
    ] = ('-inf', 'inf'),
    incidence: Annotated[float, typer.Option(
        min=0.0, max=90.0, help='Keep points that the laser meets at no larger angle to the '
        'surface normal, as far as a profile shows it (degrees).')] = 90.0,
    std: Annotated[bool, typer.Option(
        '--std', help='Add the 1 sigma of each point (m): calibration, sensor, robot.')] = False,
) -> None:
    """Put the profiles of a recording into the robot's base: a cloud of points."""
    from handeye_ros.bags.bag import flow
    from handeye_ros.sampling.trajectory import track_of
    from handeye_ros.scanning.cloud_files import cloud_writer, header_of
    from handeye_ros.scanning.scan import Scanner, ScanOptions
    header_of(out)
    answer, settings = calibrated(calibration, config, with_kinematics(assignments, kinematics))
    scanner = Scanner(answer, settings, ScanOptions.of_texts(limits, incidence, voxel, std))
    with doing('reading the poses') as update:
        source = flow(bag, settings)
        track = track_of(source.poses, settings.sampling.max_pose_gap)
        with cloud_writer(out, f'frame {scanner.frame}, metres') as writer:
            for points in scanner.scan(source.profiles(), track):
                writer.write(points)
                update(f'{scanner.count.profiles} profiles, {writer.count} points')
            scanner.require_points()
    for warning in source.warnings:
        warn(warning)
    typer.echo(_scan_sentence(scanner.count))
    typer.echo(f'wrote {out.absolute()}: {writer.count} points in {scanner.frame}')


def _scan_sentence(count: 'ScanCount') -> str:
    dropped = [f'{number} {reason}' for number, reason in (
        (count.without_pose, 'profiles without a pose'),
        (count.out_of_limits, 'points outside the limits'),
        (count.thinned, 'points thinned out')) if number]
    return f'{count.profiles} profiles, {count.returns} returns' + (
        f'; left out: {", ".join(dropped)}' if dropped else '')


NO_BOX = ('-inf', 'inf') * 3
FAR = 10.0  # m: a larger plain number is taken for mm, and refused
THINNED = 2e-4  # m: edge of the cubes, each with one point

Source = Annotated[Path, typer.Argument(
    metavar='CLOUD_OR_BAG', help='A .ply or .pcd file, or a bag with --calibration.')]
SeamOut = Annotated[Path, typer.Option(
    metavar='DIR', help='Where seam.csv and seam.yaml are written.')]
Calibrated = Annotated[NoPath, typer.Option(
    metavar='FILE', help='The calibration.yaml that puts a bag into the base.')]
Pitch = Annotated[str, typer.Option(
    metavar='L', help='Distance between tool frames along the seam (5mm, or metres).')]
Box = Annotated[tuple[str, str, str, str, str, str], typer.Option(
    metavar='X X Y Y Z Z', help='Use the points between these values; -inf, inf: no limit.')]
Widest = Annotated[str, typer.Option(
    metavar='L', help='Largest distance between the edges of the seam.')]
Towards = Annotated[tuple[float, float, float], typer.Option(
    metavar='X Y Z', help='The tool approaches the part this way rather than the other.')]
Travel = Annotated[float, typer.Option(help='The tool leans along the seam (degrees).')]
Work = Annotated[float, typer.Option(help='The tool leans across the seam (degrees).')]


def _one_of(*names: str) -> Callable[[Any], Any]:
    """Return a callback that refuses other values."""
    def checked(value: Any) -> Any:
        for name in [value] if isinstance(value, str) else value or ():
            if name not in names:
                raise typer.BadParameter(f'{name!r} is not one of {", ".join(names)}')
        return value
    return checked


Line = Annotated[str, typer.Option(
    callback=_one_of('auto', 'centre', 'root', 'first', 'second'),
    help='What the path follows: auto (the root of V and fillet, the centre of butt and lap), '
    'centre, root, first or second edge.')]
Start = Annotated[tuple[str, str, str], typer.Option(
    metavar='X Y Z', help='A place near the end where the path starts.')]
AsBag = Annotated[bool, typer.Option(
    '--bag', help='Write nav_msgs/Path and geometry_msgs/PoseArray to DIR/path too.')]


@app.command()
def seam(
    path: Source,
    out: SeamOut = Path('out/seam'),
    calibration: Calibrated = None,
    config: MeasureConfig = None,
    assignments: Assignments = [],  # noqa: B006 - never changed
    pitch: Pitch = '5mm',
    box: Box = NO_BOX,
    widest: Widest = '12mm',
    towards: Towards = (0.0, 0.0, -1.0),
    travel: Travel = 0.0,
    work: Work = 0.0,
    line: Line = 'auto',
    start: Start = NOWHERE,
    bag: AsBag = False,
) -> None:
    """Find the seam in a cloud, and plan tool frames along it (Wu 2017)."""
    from handeye_ros.scanning import seam_files
    from handeye_ros.scanning.seam import find_seam, tool_frames
    import numpy as np
    low, high = np.reshape(units.limits(box, '--box', FAR), (3, 2)).T
    gap = units.length(widest, '--widest', 0.1, 1e-4)
    spacing = units.length(pitch, '--pitch', 0.1, 1e-5)
    begin = [units.length(text, '--start', FAR) for text in start] if start[0] else None
    points, frame = _cloud(path, calibration, config, assignments)
    points = points[((points >= low) & (points <= high)).all(axis=1)]
    with doing('looking for the seam'):
        result = find_seam(points, gap, towards, line, begin)
        frames = tool_frames(result, spacing, towards, math.radians(travel), math.radians(work))
    seam_files.write(out, result, frames, frame)
    if bag:
        import time

        from handeye_ros.bags.bag_write import write_path
        write_path(out / 'path', frames.T_base_tool, frame, time.time_ns(), force=True)
    for line in seam_files.sentences(result, frames):
        typer.echo(line)
    typer.echo(f'wrote {out.absolute()}')


def _cloud(path: Path, calibration: Path | None, config: Path | None, assignments: list[str]
           ) -> tuple['Array', str]:
    """Return the points (n, 3) of a cloud or a bag, and their frame."""
    from handeye_ros.errors import InputError
    from handeye_ros.scanning.cloud_files import FORMATS, read_cloud
    import numpy as np
    if path.suffix.lower() in FORMATS:
        return read_cloud(path), 'base'
    if calibration is None:
        raise InputError(f'{path} is no .ply or .pcd file; to use it as a bag, give the '
                         'calibration of its sensor: --calibration FILE')
    from handeye_ros.bags.bag import flow
    from handeye_ros.sampling.trajectory import track_of
    from handeye_ros.scanning.scan import Scanner, ScanOptions
    answer, settings = calibrated(calibration, config, assignments)
    scanner = Scanner(answer, settings, ScanOptions(voxel=THINNED))
    with doing('scanning'):
        source = flow(path, settings)
        parts = list(scanner.scan(source.profiles(),
                                  track_of(source.poses, settings.sampling.max_pose_gap)))
    scanner.require_points()
    rows = np.concatenate(parts)
    return np.column_stack([rows[axis] for axis in 'xyz']).astype(float), scanner.frame
