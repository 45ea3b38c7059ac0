"""The verb that predicts what a verification will show, and proposes its stops."""
import math
from pathlib import Path
from typing import Annotated

from handeye_ros import units
from handeye_ros.cli.common import app, Assignments, NoPath
from handeye_ros.cli.scan import calibrated, CalibrationFile, MeasureConfig
from handeye_ros.cli.verify import (
    Aim,
    AngleTolerance,
    Certificate,
    keys,
    Lengths,
    Name,
    Radius,
    Tolerance,
    USUAL,
)
import typer

COUNTS = (8, 14, 20, 30, 45)  # stops that are tried beside those asked for

At = Annotated[tuple[str, str, str], typer.Option(
    metavar='X Y Z', help='Where the artefact will stand in the base, its face upwards (with '
    'eye_on_base: on the flange).')]
Stops = Annotated[int, typer.Option(min=4, max=500, help='Stops at each part.')]
Turns = Annotated[float, typer.Option(
    min=1.0, max=80.0, help="Largest turn about each of the sensor's axes (degrees).")]
Limits = Annotated[tuple[str, str], typer.Option(
    '--range', metavar='NEAR FAR', help='Nearest and farthest distance from the sensor.')]
Out = Annotated[NoPath, typer.Option(metavar='FILE', help='Write the stops (CSV).')]


@app.command()
def plan(
    name: Name,
    calibration: CalibrationFile,
    at: At,
    stops: Stops = 20,
    turns: Turns = 40.0,
    limits: Limits = ('150mm', '200mm'),
    config: MeasureConfig = None,
    assignments: Assignments = [],  # noqa: B006 - never changed
    length: Lengths = [],  # noqa: B006 - never changed
    radius: Radius = None,
    aim: Aim = None,
    certificate: Certificate = None,
    tolerance: Tolerance = None,
    angle_tolerance: AngleTolerance = None,
    out: Out = None,
) -> None:
    """Predict what a verification will show before it is measured, and propose its stops."""
    from functools import partial

    from handeye_ros.config import with_values
    from handeye_ros.output import write_whole
    from handeye_ros.verification import plan as planning
    from handeye_ros.verification.routines import routine_of
    found, settings = calibrated(calibration, config, assignments)
    settings = with_values(settings, keys({
        'lengths': length, 'radius': radius, 'aim': aim, 'certificate': certificate,
        'tolerance': tolerance}, angle_tolerance), 'the options')
    near, far = (units.length(text, '--range', USUAL['near']) for text in limits)
    place = [units.length(text, '--at', USUAL['near']) for text in at]
    planned = partial(planning.plan, routine_of(name), found, settings, place,
                      turns=math.radians(turns), limits=(near, far))
    best = planned(stops=stops)
    for sentence in planning.sentences(best, [planned(stops=n) for n in COUNTS if n != stops]):
        typer.echo(sentence)
    if out:
        write_whole(out, planning.csv_text(best))
        typer.echo(f'wrote {Path(out).absolute()}')
