"""The verb that finds a seam and plans the path along it."""
from collections.abc import Callable, Sequence
import math
from pathlib import Path
from typing import Annotated, Any, Optional, TYPE_CHECKING

from handeye_ros import units
from handeye_ros.cli.common import app, Assignments, doing, NoPath
from handeye_ros.cli.scan import calibrated, MeasureConfig
import typer

if TYPE_CHECKING:
    from handeye_ros.data import Array
    from handeye_ros.scanning.seam import Seam, ToolFrames

NOWHERE = ('', '', '')  # the typer of Jazzy knows no tuple without a value
NO_BOX = ('-inf', 'inf') * 3
FAR = 10.0  # m: a larger plain number meant mm
THINNED = 2e-4  # m: edge of the cubes of which a scan keeps a point

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
TaughtFile = Annotated[NoPath, typer.Option(
    metavar='FILE', help='A taught path to compare with: CSV with x, y, z (m).')]


def _one_of(*known: str) -> Callable[[Any], Any]:
    """Return what refuses values that are none of those known."""
    def checked(value: Any) -> Any:
        for one in [value] if isinstance(value, str) else value or ():
            if one not in known:
                raise typer.BadParameter(f'{one!r} is not one of {", ".join(known)}')
        return value
    return checked


Line = Annotated[str, typer.Option(
    callback=_one_of('auto', 'centre', 'root', 'first', 'second'),
    help='What the path follows: auto (the root of V and fillet, the centre of butt and lap), '
    'centre, root, first or second edge.')]
Start = Annotated[tuple[str, str, str], typer.Option(
    metavar='X Y Z', help='A place near the end where the path starts.')]
Programs = Annotated[Optional[list[str]], typer.Option(  # noqa: UP045 - see common.py
    '--robot', callback=_one_of('krl', 'rapid', 'ur'), help='Also write a program: krl (KUKA), '
    'rapid (ABB) or ur (Universal Robots); may be given several times.')]
AsBag = Annotated[bool, typer.Option(
    '--bag', help='Write nav_msgs/Path and geometry_msgs/PoseArray to DIR/path too.')]
Picture = Annotated[bool, typer.Option(
    '--picture', help='Draw DIR/seam.png (needs matplotlib).')]


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
    taught: TaughtFile = None,
    robot: Programs = None,
    bag: AsBag = False,
    picture: Picture = False,
) -> None:
    """Find the seam in a cloud, and plan tool frames along it (Wu 2017)."""
    from handeye_ros.scanning import seam_files
    from handeye_ros.scanning.seam import find_seam, tool_frames
    import numpy as np
    low, high = np.reshape(units.limits(box, '--box', FAR), (3, 2)).T
    gap = units.length(widest, '--widest', 0.1, 1e-4)
    each = units.length(pitch, '--pitch', 0.1, 1e-5)
    begin = [units.length(text, '--start', FAR) for text in start] if start[0] else None
    compared = seam_files.read_taught(taught) if taught else None
    points, frame = _cloud(path, calibration, config, assignments)
    points = points[((points >= low) & (points <= high)).all(axis=1)]
    with doing('looking for the seam'):
        found = find_seam(points, gap, towards, line, begin)
        frames = tool_frames(found, each, towards, math.radians(travel), math.radians(work))
    distances = seam_files.against_taught(found, compared) if compared is not None else None
    seam_files.write(out, found, frames, frame, distances)
    _more(found, frames, frame, out, robot or (), bag, picture)
    for line in seam_files.sentences(found, frames, distances):
        typer.echo(line)
    typer.echo(f'wrote {out.absolute()}')


def _cloud(path: Path, calibration: Path | None, config: Path | None, assignments: list[str]
           ) -> tuple['Array', str]:
    """Return the points (n, 3) of a cloud or a bag, and their frame."""
    from handeye_ros.scanning.cloud_files import FORMATS, read_cloud
    from handeye_ros.scanning.errors import NeedsCalibrationError
    import numpy as np
    if path.suffix.lower() in FORMATS:
        return read_cloud(path), 'base'
    if calibration is None:
        raise NeedsCalibrationError(path)
    from handeye_ros.ros.bags.bag import flow
    from handeye_ros.sampling.trajectory import track_of
    from handeye_ros.scanning.scan import Scanner, ScanOptions
    found, settings = calibrated(calibration, config, assignments)
    scanner = Scanner(found, settings, ScanOptions(voxel=THINNED))
    with doing('scanning'):
        source = flow(path, settings)
        pieces = list(scanner.scan(source.profiles(),
                                   track_of(source.poses, settings.sampling.max_pose_gap)))
    scanner.require_points()
    rows = np.concatenate(pieces)
    return np.column_stack([rows[axis] for axis in 'xyz']).astype(float), scanner.frame


def _more(found: 'Seam', frames: 'ToolFrames', frame: str, out: Path, robots: Sequence[str],
          bag: bool, picture: bool) -> None:
    from handeye_ros.output import write_whole
    from handeye_ros.scanning import seam_files
    for robot in robots:
        name, program = seam_files.PROGRAMS[robot]
        write_whole(out / name, program(frames, frame))
    if bag:
        import time

        from handeye_ros.ros.bags.bag_write import write_path
        write_path(out / 'path', frames.T_base_tool, frame, time.time_ns(), force=True)
    if picture:
        from handeye_ros.scanning.pictures import draw_seam
        draw_seam(found, frames, out / 'seam.png')
