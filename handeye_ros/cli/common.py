# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Common to the verbs: arguments, reading of their files, and output.

The slow imports are inside functions, here and in the verbs, so that help and wrong usage respond
at once. No `from __future__ import annotations`, here and in the verbs: the typer of Jazzy (0.9)
does not evaluate such annotations.
"""
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
import sys
from typing import Annotated, Any, Optional, TYPE_CHECKING

from handeye_ros import __version__
from handeye_ros.errors import HandeyeError
import typer
from typer.core import TyperGroup

if TYPE_CHECKING:
    from handeye_ros.bags.bag import Recording
    from handeye_ros.bags.session import Stored
    from handeye_ros.config import Config
    from handeye_ros.data import Calibration
    from handeye_ros.sampling.session import Session
    from handeye_ros.sampling.trajectory import Trajectory

NoPath = Optional[Path]  # noqa: UP045 - the typer of Jazzy does not know `Path | None`
Bag = Annotated[Path, typer.Argument(help='A rosbag2 folder, or an .mcap or .db3 file.')]
Input = Annotated[Path, typer.Argument(metavar='INPUT', help=(
    'A bag: a rosbag2 folder, or an .mcap or .db3 file; for points and hand_eye a CSV '
    'file.'))]
ConfigFile = Annotated[NoPath, typer.Option(
    help='A ROS parameter file, such as config/plate.yaml; without it, the defaults.')]
Assignments = Annotated[list[str], typer.Option(
    '--set', metavar='KEY=VALUE', help='Set a key of the configuration; may be repeated. Plain '
    'numbers are metres, radians and seconds; 20mm and 0.1deg are understood.')]
KinematicsFile = Annotated[NoPath, typer.Option(
    '--kinematics', metavar='FILE', help='A kinematics.yaml, for a bag that holds joint values: '
    'the flange poses are those of its corrected arm.')]
Angles = Annotated[str, typer.Option(
    metavar='NOTATION', help='How a table of poses writes orientations: kuka-abc, fanuc-wpr, '
    'abb-quaternion, ur-rotation-vector, staubli-rxryrz or yaskawa-rxryrz.')]
CalibrationFile = Annotated[Path, typer.Option(
    '--calibration', metavar='FILE', help='The calibration.yaml of this sensor.')]
MeasureConfig = Annotated[NoPath, typer.Option(
    help='A ROS parameter file; without it, the settings that the calibration was made with.')]
OutFile = Annotated[NoPath, typer.Option(metavar='FILE', help='Write the result as YAML too.')]
TABLES = ('.csv',)  # files of measured values
INTERRUPTED = 130
ORDER = ('solve', 'calibrate', 'samples', 'report', 'export', 'compare', 'verify', 'check',
         'trend', 'kinematics', 'scan', 'seam', 'batch', 'replay', 'simulate')  # as help lists


def configuration(file: Path | None, assignments: list[str], base: 'Config | None' = None,
                  angles: str = '') -> 'Config':
    """
    Return the base (default: the defaults) with the keys of a file, and those set by hand.

    angles: the notation of a table of poses.
    """
    from handeye_ros.config import Config, load, with_assignments
    from handeye_ros.units import assigned
    base = base or Config()
    assignments = [*assignments, f'target.angles={angles}'] if angles else assignments
    return with_assignments(load(file, base) if file else base, map(assigned, assignments))


def calibrated(file: Path, config: Path | None, assignments: list[str]
               ) -> 'tuple[Calibration, Config]':
    """Return a calibration, and the settings to measure with it."""
    from handeye_ros.config import load
    from handeye_ros.results.calibration_file import read_calibration, use_config
    calibration = read_calibration(file)
    settings = use_config(calibration, load(config) if config else None)
    return calibration, configuration(None, assignments, settings)


def with_kinematics(assignments: list[str], file: Path | None) -> list[str]:
    """Return assignments, preceded by those of a kinematics.yaml."""
    if file is None:
        return assignments
    from handeye_ros.arm import read_arm
    arm = read_arm(file)
    return [f'kinematics={file.absolute()}', f'robot_base_frame={arm.base}',
            f'robot_effector_frame={arm.flange}', *assignments]


def stored_session(path: Path) -> 'Stored | None':
    """Return the session in a folder, None if there is none."""
    if not path.is_dir():
        return None
    from handeye_ros.bags.session import is_session, read_session
    return read_session(path) if is_session(path) else None


def read_bag(bag: Path, settings: 'Config') -> 'Recording':
    """Return the contents of a bag; print its warnings."""
    with advancing('reading the recording') as progress:
        from handeye_ros.bags.bag import read
        recording = read(bag, settings, progress)
    for warning in recording.warnings:
        warn(warning)
    return recording


def gathered(bag: Path, settings: 'Config') -> 'Session':
    """Return the samples of a bag; print its warnings."""
    recording = read_bag(bag, settings)
    with doing('finding the samples'):
        from handeye_ros import pipeline
        return pipeline.gather(recording.profiles, recording.poses, settings)


@contextmanager
def flowing(bag: Path, settings: 'Config', task: str
            ) -> 'Iterator[tuple[Recording, Trajectory, Callable[[str], None]]]':
    """Give a recording profile by profile, its poses, and a function that changes the task."""
    from handeye_ros.bags.bag import read
    from handeye_ros.sampling.trajectory import track_of
    with doing(task) as update:
        # what uses the profiles adds the offset itself
        recording = read(bag, replace(settings, time_offset=0.0))
        yield recording, track_of(recording.poses, settings.sampling.max_pose_gap), update
    for warning in recording.warnings:
        warn(warning)


def warn(text: str) -> None:
    """Print a warning."""
    typer.echo(f'warning: {text}', err=True)


@contextmanager
def doing(task: str) -> Iterator[Callable[[str], None]]:
    """Show a task on a terminal, quiet in a pipe; yields a function that changes its name."""
    if not sys.stderr.isatty():
        yield lambda now: None
        return
    from rich.console import Console
    with Console(stderr=True).status(task) as status:
        yield status.update


@contextmanager
def advancing(name: str) -> Iterator[Callable[[float], None]]:
    """Show a bar on a terminal; yields a function of the completed fraction."""
    if not sys.stderr.isatty():
        yield lambda share: None
        return
    from rich.console import Console
    from rich.progress import Progress
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, total=1.0)
        yield lambda share: bar.update(task, completed=share)


def show(renderable: Any) -> None:
    """Print a table."""
    from rich.console import Console
    console = Console()
    if not console.is_terminal:
        console = Console(width=160, color_system=None)  # a pipe has no width to wrap at
    console.print(renderable)


class Verbs(TyperGroup):
    """Turns errors into a sentence and an exit code; orders the verbs in the help."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the verbs."""
        return sorted(super().list_commands(ctx), key=ORDER.index)

    def invoke(self, ctx: Any) -> Any:
        """Run a verb."""
        try:
            return super().invoke(ctx)
        except HandeyeError as error:
            typer.echo(f'error: {" ".join(str(error).split())}', err=True)
            raise typer.Exit(error.exit_code) from None
        except KeyboardInterrupt:
            raise typer.Exit(INTERRUPTED) from None


app = typer.Typer(cls=Verbs, no_args_is_help=True, rich_markup_mode=None,
                  pretty_exceptions_enable=False)


def _print_version(requested: bool) -> None:
    if requested:
        typer.echo(f'handeye_ros {__version__}')
        raise typer.Exit


@app.callback()
def _options(version: Annotated[bool, typer.Option(
        '--version', callback=_print_version, is_eager=True,
        help='Print the version and exit.')] = False) -> None:
    """Hand-eye calibration of laser line profilers."""
