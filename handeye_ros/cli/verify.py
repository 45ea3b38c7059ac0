"""The verb that verifies a calibration on a known artefact."""
from collections.abc import Mapping, Sequence
from dataclasses import replace
import math
from pathlib import Path
from typing import Annotated, Optional, TYPE_CHECKING

from handeye_ros import units
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
from handeye_ros.cli.scan import calibrated, CalibrationFile, MeasureConfig, NOWHERE
import typer

if TYPE_CHECKING:
    from handeye_ros.config import Config
    from handeye_ros.data import Calibration, Sample
    from handeye_ros.verification.routines import Routine
    from handeye_ros.verification.shapes import StationSet
    from handeye_ros.verification.verification import Verification

NOT_PASSED = 1  # exit code: the verification did not pass
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
Out = Annotated[NoPath, typer.Option(metavar='FILE', help='Write the result as YAML too.')]
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
    out: Out = None,
    stations: StationsFile = None,
    protocol: Protocol = None,
) -> None:
    """Measure something known with a calibration: exit code 0 only for a pass, 1 otherwise."""
    from handeye_ros.config import with_values
    from handeye_ros.verification import verification
    from handeye_ros.verification.routines import routine_of
    routine = routine_of(name)
    answer, settings = calibrated(calibration, config, with_kinematics(assignments, kinematics))
    options = {'lengths': length, 'radius': radius, 'reference': reference if reference[0] else (),
               'aim': aim, 'flank': flank, 'certificate': certificate, 'tolerance': tolerance,
               'near': near if near[0] else ()}
    settings = with_values(settings, keys(options, angle_tolerance), 'the options')
    result = _verified(routine, bags, answer, settings)
    show(verification.table(result))
    _write(result, out, stations, protocol)
    for sentence in (*filter(None, [result.surface]), result.verdict, *result.reasons):
        typer.echo(sentence)
    if result.verdict != 'pass':
        raise typer.Exit(NOT_PASSED)


def _write(result: 'Verification', out: Path | None, stations: Path | None,
           protocol: Path | None) -> None:
    from handeye_ros.output import write_whole
    from handeye_ros.verification import verification
    if out:
        write_whole(out, verification.yaml_text(result))
    if stations:
        write_whole(stations, verification.stations_csv(result))
    if protocol:
        from handeye_ros.results import pages
        write_whole(protocol, pages.protocol(verification.values(result)))


def _verified(routine: 'Routine', bags: list[Path], calibration: 'Calibration',
              config: 'Config') -> 'Verification':
    from handeye_ros import pipeline
    from handeye_ros.verification.routines import TEETH
    from handeye_ros.verification.verify import settings_for, stations_of, verify
    settings = settings_for(routine, config, len(bags))
    scanned = routine.target == TEETH
    stations_of_bags, reason = [], ''
    for bag in bags:
        if scanned:
            stations_of_bags.append(_pass(bag, settings))
            continue
        recording = read_bag(bag, settings)
        with doing('finding the stations'):
            session = pipeline.gather(recording.profiles, recording.poses, settings)
        _warn_of_used(bag, calibration, session.samples)
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


def _warn_of_used(bag: Path, calibration: 'Calibration', samples: 'Sequence[Sample]') -> None:
    used = {report.stamp for report in calibration.samples if report.used}
    if any(sample.stamp in used for sample in samples):
        warn(f'{bag} holds stations that the calibration was made of: they agree with it too '
             'well; measure at others')
