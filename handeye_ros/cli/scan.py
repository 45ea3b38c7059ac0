"""The verb that puts a recording into the base: scan."""
from pathlib import Path
from typing import Annotated, TYPE_CHECKING

from handeye_ros.cli.common import (
    app,
    Assignments,
    Bag,
    doing,
    KinematicsFile,
    NoPath,
    warn,
    with_kinematics,
)
import typer

if TYPE_CHECKING:
    from handeye_ros.config import Config
    from handeye_ros.data import Calibration
    from handeye_ros.scanning.scan import ScanCount

CalibrationFile = Annotated[Path, typer.Option(
    '--calibration', metavar='FILE', help='The calibration.yaml of this sensor.')]
MeasureConfig = Annotated[NoPath, typer.Option(
    help='A ROS parameter file; without it, the settings that the calibration was made with.')]


def calibrated(file: Path, config: Path | None, assignments: list[str]
               ) -> tuple['Calibration', 'Config']:
    """Return a calibration, and the settings that read what is measured with it."""
    from handeye_ros.config import load, with_assignments
    from handeye_ros.results.calibration_file import read_calibration
    from handeye_ros.results.report.evidence import use_config
    calibration = read_calibration(file)
    settings = use_config(calibration, load(config) if config else None)
    return calibration, with_assignments(settings, assignments)


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
    from handeye_ros.ros.bags.bag import flow
    from handeye_ros.sampling.trajectory import track_of
    from handeye_ros.scanning.cloud_files import cloud_writer, header_of
    from handeye_ros.scanning.scan import Scanner, ScanOptions
    header_of(out)
    found, settings = calibrated(calibration, config, with_kinematics(assignments, kinematics))
    scanner = Scanner(found, settings, ScanOptions.of_texts(limits, incidence, voxel, std))
    with doing('reading the poses') as now:
        source = flow(bag, settings)
        track = track_of(source.poses, settings.sampling.max_pose_gap)
        with cloud_writer(out, f'frame {scanner.frame}, metres') as writer:
            for points in scanner.scan(source.profiles(), track):
                writer.write(points)
                now(f'{scanner.count.profiles} profiles, {writer.count} points')
            scanner.require_points()
    for warning in source.warnings:
        warn(warning)
    typer.echo(_scan_sentence(scanner.count))
    typer.echo(f'wrote {out.absolute()}: {writer.count} points in {scanner.frame}')


def _scan_sentence(count: 'ScanCount') -> str:
    lost = [f'{number} {what}' for number, what in (
        (count.without_pose, 'profiles without a pose'),
        (count.out_of_limits, 'points outside the limits'),
        (count.thinned, 'points thinned out')) if number]
    return f'{count.profiles} profiles, {count.returns} returns' + (
        f'; left out: {", ".join(lost)}' if lost else '')
