# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The verbs that use a calibration: to measure, scan and find seams; and whether it holds."""
from enum import StrEnum
import math
import operator
from pathlib import Path
from typing import Annotated, TYPE_CHECKING

from handeye_ros.cli.common import (
    app,
    Assignments,
    Bag,
    CalibrationFile,
    collect_samples,
    file_option,
    folder_option,
    KinematicsFile,
    length_option,
    MeasureConfig,
    open_bag,
    open_calibration,
    OptionalPath,
    OutFile,
    progress_bar,
    require_html_name,
    show,
    stream_recording,
    warn,
    warn_of_frame,
    write_yaml,
)
from handeye_ros.errors import BadValueError, InputError, looked_up
from handeye_ros.scanning import DEFAULT_TOWARDS, DEFAULT_WIDEST
import typer

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from handeye_ros.config import Config
    from handeye_ros.data import Array, Calibration, Profile, Reject, Sample
    from handeye_ros.sampling.trajectory import Trajectory
    from handeye_ros.verification.check import Check

NOT_AS_WANTED = 1  # exit code: measured, and not passed, or changed
SAME_STAMP_NS = 100_000  # ns: profiles are further apart, and an offset estimated anew is nearer
NO_LIMITS = ('-inf', 'inf')
MAX_PLAIN = 10.0  # a position without a unit that is larger was meant in mm: refused
THINNING_SIZE = 2e-4  # m: edge of the cubes of which each keeps one point
# that the path of a tool may follow
PathLine = StrEnum('PathLine', ['auto', 'centre', 'root', 'first', 'second'])


@app.command()
def verify(
    name: Annotated[str, typer.Argument(  # of ROUTINES (test_cli.py), whose import takes long
        metavar='ROUTINE', help='line, plane, point, sphere, ball_bar, step, square or tooth.')],
    bags: Annotated[list[Path], typer.Argument(metavar='BAG...', help=(
        'Recordings with stops, one of each face or ball, in their order.'))],
    calibration_file: CalibrationFile,
    config: MeasureConfig = None,
    assignments: Assignments = [],
    kinematics: KinematicsFile = None,
    out: OutFile = None,
    protocol: Annotated[OptionalPath, file_option(help='Write an HTML page to print.')] = None,
) -> None:
    """
    Measure something known with a calibration.

    The exit code is 0 for a pass, 1 for another verdict, 2 and 3 for none (as of every verb).

    The artefact and the tolerances are keys, such as --set verify.radius=20mm
    --set verify.lengths=[200mm] --set verify.tolerance=0.3mm; docs/measure.md tells which of them
    a routine needs.
    """
    from handeye_ros.output import write_atomically
    from handeye_ros.results.calibration_file import file_of
    from handeye_ros.verification import result_file
    from handeye_ros.verification.routines import ROUTINES
    from handeye_ros.verification.stations import stations_of_passes
    from handeye_ros.verification.verify import verify_stations, verify_stops
    if protocol:
        require_html_name(protocol)
    routine = looked_up('routine', name, ROUTINES)
    calibration, settings = open_calibration(calibration_file, config, assignments, kinematics)
    settings = routine.settings(settings, len(bags))
    if routine.in_passes:
        scanned = stations_of_passes(_passes(bags, calibration, settings), calibration, settings)
        result = verify_stations(routine, scanned, calibration)
    else:
        stops = [_stops(bag, calibration, settings) for bag in bags]
        result = verify_stops(routine, stops, calibration, settings)
    content = result_file.plain_values(result, bags, file_of(calibration_file))
    show(result_file.table(content))
    write_yaml(out, content)
    if protocol:
        write_atomically(protocol, result_file.protocol(content))
    for sentence in (*filter(None, [result.surface]), result.verdict, *result.reasons):
        typer.echo(sentence)
    if result.verdict != 'pass':
        raise typer.Exit(NOT_AS_WANTED)


def _passes(bags: list[Path], calibration: 'Calibration', config: 'Config'
            ) -> 'Iterator[tuple[Sequence[Profile], Trajectory]]':
    """Yield the profiles and the poses of the pass in each recording."""
    for bag in bags:
        with stream_recording(bag, config, calibration) as (recording, trajectory):
            yield list(recording.profiles_of_returns()), trajectory


def _stops(bag: Path, calibration: 'Calibration', config: 'Config') -> 'list[Sample | Reject]':
    """Return the sample of each stop of a recording, or why it gave none; print warnings."""
    recording = open_bag(bag, config)
    warn_of_frame(recording, calibration)
    session = collect_samples(recording, config)
    samples = session.samples
    _warn_of_calibration_samples(bag, [sample.stamp for sample in samples], calibration, config)
    return [*samples, *session.rejects]


def _warn_of_calibration_samples(bag: Path, stamps: 'Sequence[int]', calibration: 'Calibration',
                                 config: 'Config') -> None:
    """Warn where samples with these stamps (ns) are those from which a calibration was made."""
    from handeye_ros.results.calibration_file import config_of
    import numpy as np
    later = config.time_offset - config_of(calibration).time_offset
    own = [report.stamp + round(later * 1e9) for report in calibration.samples if report.used]
    if (np.abs(np.subtract.outer(stamps, own)) < SAME_STAMP_NS).any():
        warn(f'{bag} holds stations with the stamps of those that the calibration was made of: '
             'if they are the same, they agree with it too well; measure at others')


@app.command()
def check(
    bags: Annotated[list[Path], typer.Argument(
        metavar='BAG...', help='Short recordings of the same target, the oldest first.')],
    against: Annotated[Path, file_option(help='The calibration.yaml to check, or its folder.')],
    config: MeasureConfig = None,
    assignments: Assignments = [],
    kinematics: KinematicsFile = None,
    out: OutFile = None,
) -> None:
    """
    Check with short recordings of its target whether a calibration still holds.

    The exit code is 0 if nothing has changed, 1 for a change, 2 and 3 if that cannot be told.
    """
    from handeye_ros.verification.check import check_recording, plain_values
    calibration, settings = open_calibration(against, config, assignments, kinematics)
    checks: list[tuple[str, Check]] = []
    try:
        for bag in bags:
            recording = open_bag(bag, settings)
            warn_of_frame(recording, calibration)
            with progress_bar('comparing'):
                result = check_recording(
                    recording.profiles, recording.poses, calibration, settings)
            _warn_of_calibration_samples(bag, result.stamps, calibration, settings)
            checks.append((str(bag), result))
            typer.echo(f'{bag} ({result.stations} stations): {result.verdict.upper()}: '
                       f'{result.sentence}')
    finally:  # a recording that is refused loses nothing of the others
        if checks:
            write_yaml(out, plain_values(checks, str(against)))
    if any(result.verdict != 'unchanged' for _, result in checks):
        raise typer.Exit(NOT_AS_WANTED)


@app.command()
def trend(
    folder: Annotated[Path, typer.Argument(
        metavar='DIR', help='All calibration.yaml below this folder are compared.')],
    against: Annotated[OptionalPath, file_option(
        help='Compare with this calibration.yaml; default: with the oldest.')] = None,
    csv: Annotated[OptionalPath, file_option(help='Write the calibrations as CSV.')] = None,
) -> None:
    """Show how the calibrations below a folder changed with time."""
    from handeye_ros import trend as trends
    from handeye_ros.output import write_atomically
    from handeye_ros.results.calibration_file import read_calibration
    entries, warnings = trends.trend(
        folder, read_calibration(against) if against else None)
    warn(*warnings)
    show(trends.table(entries))
    typer.echo(trends.since_when(entries))
    if csv:
        write_atomically(csv, trends.csv_text(entries))
        typer.echo(f'wrote {csv.absolute()}')


@app.command()
def scan(
    bag: Bag,
    calibration_file: CalibrationFile,
    out: Annotated[Path, typer.Option(metavar='CLOUD', help='The file to write: .ply or .pcd.')],
    config: MeasureConfig = None,
    assignments: Assignments = [],
    kinematics: KinematicsFile = None,
    voxel: Annotated[str, length_option(help='Keep a point of each cube with this edge.')] = '0',
    limits: Annotated[tuple[str, str], typer.Option(
        '--range', metavar='NEAR FAR', help='Keep points in this range of the sensor.')
    ] = NO_LIMITS,
    incidence: Annotated[float, typer.Option(
        help='Largest angle between range axis and surface normal in a profile (degrees).')
    ] = 90.0,
    std: Annotated[bool, typer.Option('--std', help='Add the 1 sigma of each point (m).')] = False,
) -> None:
    """Put profiles into the base frame (eye_on_base: of the flange), as a cloud of points."""
    from handeye_ros.scanning.cloud import require_suffix, write_cloud
    from handeye_ros.scanning.scan import Scanner, ScanOptions
    require_suffix(out)
    calibration, settings = open_calibration(calibration_file, config, assignments, kinematics)
    scanner = Scanner(calibration, settings, ScanOptions.of_texts(limits, incidence, voxel, std))
    with stream_recording(bag, settings, calibration) as (recording, trajectory):
        pieces = scanner.scan(recording.profiles_of_returns(), trajectory)
        write_cloud(out, pieces, f'frame {scanner.frame}, metres')
    typer.echo(f'{scanner.profiles} profiles, {scanner.returns} returns')
    typer.echo(f'dropped: {scanner.without_pose} profiles without a pose, '
               f'{scanner.out_of_limits} points outside the limits, {scanner.thinned} thinned out')
    typer.echo(f'wrote {out.absolute()}: {scanner.kept} points in {scanner.frame}')


@app.command()
def seam(
    path: Annotated[Path, typer.Argument(
        metavar='CLOUD_OR_BAG', help='A .ply or .pcd file, or a bag with --calibration.')],
    out: Annotated[Path, folder_option(help='For seam.csv and seam.yaml.')] = Path('out/seam'),
    calibration_file: Annotated[OptionalPath, file_option(
        '--calibration', help='The calibration.yaml that puts a bag into the base.')] = None,
    config: MeasureConfig = None,
    assignments: Assignments = [],
    kinematics: KinematicsFile = None,
    pitch: Annotated[str, length_option(help='Distance between tool frames.')] = '5mm',
    box: Annotated[tuple[str, str, str, str, str, str], typer.Option(
        metavar='X X Y Y Z Z', help='Use the points between these values; -inf, inf: no limit.')
    ] = 3 * NO_LIMITS,
    widest: Annotated[str, length_option(
        help='Largest distance between the edges of the seam.')] = f'{1e3 * DEFAULT_WIDEST:g}mm',
    towards: Annotated[tuple[float, float, float], typer.Option(
        metavar='X Y Z', help='The tool approaches the part this way.')] = DEFAULT_TOWARDS,
    travel: Annotated[float, typer.Option(help='The tool leans along the seam (degrees).')] = 0.0,
    work: Annotated[float, typer.Option(help='The tool leans across it (degrees).')] = 0.0,
    line: Annotated[PathLine, typer.Option(
        help='The path; auto: the root of V and fillet, else the centre.')] = PathLine.auto,
    start: Annotated[tuple[str, str, str], typer.Option(
        metavar='X Y Z', help='A place near the end where the path starts.')] = ('', '', ''),
    bag: Annotated[bool, typer.Option(
        '--bag', help='Write nav_msgs/Path and PoseArray to DIR/path too.')] = False,
) -> None:
    """Find the seam in a cloud, and tool frames along it."""
    if not (abs(travel) < 90.0 and abs(work) < 90.0):
        raise typer.BadParameter('--travel and --work: a tool leans by less than 90 degrees')
    from handeye_ros.scanning.seam import find_seam, sentences, tool_frames, write
    from handeye_ros.units import parse_length
    limits = [parse_length(text, '--box', MAX_PLAIN) for text in box]
    if any(map(operator.gt, limits[::2], limits[1::2])):
        raise BadValueError('--box', ' '.join(box), 'of each axis the lower limit first')
    if not 0.0 < math.hypot(*towards) < math.inf:
        raise BadValueError('--towards', towards, 'a direction')
    widest_m = parse_length(widest, '--widest', 0.1, 1e-4)
    pitch_m = parse_length(pitch, '--pitch', 0.1, 1e-5)
    start_m = [parse_length(text, '--start', MAX_PLAIN, -1e3) for text in start if any(start)]
    points, frame = _cloud(path, calibration_file, config, assignments, kinematics)
    points = points[((points >= limits[::2]) & (points <= limits[1::2])).all(axis=1)]
    with progress_bar('looking for the seam'):
        result = find_seam(points, widest_m, towards, line.value, start_m or None)
        frames = tool_frames(result, pitch_m, math.radians(travel), math.radians(work))
    write(out, result, frames, frame)
    if bag:
        import time

        from handeye_ros.bags.writer import write_path
        write_path(out / 'path', frames.T_base_tool, frame, time.time_ns())
    for sentence in sentences(result, frames):
        typer.echo(sentence)
    typer.echo(f'wrote {out.absolute()}')


def _cloud(path: Path, calibration_file: Path | None, config: Path | None,
           assignments: list[str], kinematics: Path | None) -> tuple['Array', str]:
    """Return the points (n, 3) of a cloud or a bag (m), and the id of their frame."""
    from handeye_ros.scanning.cloud import CLOUD_SUFFIXES, frame_of, read_cloud
    from handeye_ros.scanning.scan import Scanner, ScanOptions
    import numpy as np
    if path.suffix.lower() in CLOUD_SUFFIXES:
        if calibration_file or config or assignments or kinematics:
            raise InputError(f'{path} is a cloud: --calibration, --config, --set and '
                             '--kinematics are for a bag')
        return read_cloud(path), frame_of(path) or 'base'
    if calibration_file is None:
        raise InputError(f'{path} is no .ply or .pcd file; to use it as a bag, give the '
                         'calibration of its sensor: --calibration FILE')
    calibration, settings = open_calibration(calibration_file, config, assignments, kinematics)
    scanner = Scanner(calibration, settings, ScanOptions(voxel=THINNING_SIZE))
    with stream_recording(path, settings, calibration) as (recording, trajectory):
        rows = np.concatenate(list(scanner.scan(recording.profiles_of_returns(), trajectory)))
    return np.column_stack([rows[axis] for axis in 'xyz']).astype(float), scanner.frame
