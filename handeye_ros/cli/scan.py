"""The verbs that map a recording into the base, and find a seam in it."""
from collections.abc import Callable
import math
from pathlib import Path
from typing import Annotated, Any, TYPE_CHECKING

from handeye_ros import units
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
    from handeye_ros.data import Array, Calibration
    from handeye_ros.scanning.scan import ScanCount

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


NOWHERE = ('', '', '')  # the typer of Jazzy has no tuple without a value
NO_BOX = ('-inf', 'inf') * 3
FAR = 10.0  # m: a larger plain number is taken for mm, and refused
THINNED = 2e-4  # m: edge of the cubes, each with one point

Source = Annotated[Path, typer.Argument(
    metavar='CLOUD_OR_BAG', help='A .ply or .pcd file, or a bag with --calibration.')]
Out = Annotated[Path, typer.Option(
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
    out: Out = Path('out/seam'),
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
