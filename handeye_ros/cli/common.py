# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What the verbs have in common: arguments, reading of their files, output, exit codes.

The slow imports are inside functions, here and in the verbs, so that help and wrong usage respond
at once. No `from __future__ import annotations`, here and in the verbs: the typer of Jazzy (0.9)
does not evaluate such annotations.
"""
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
import os
from pathlib import Path
import sys
from typing import Annotated, Any, Optional, TYPE_CHECKING

from handeye_ros import __version__
from handeye_ros.errors import BadValueError, ERROR_MARK, HandeyeError, InputError, WARNING_MARK
import typer
from typer.core import TyperGroup

if TYPE_CHECKING:
    from handeye_ros.arm import Arm
    from handeye_ros.bags.recording import Recording
    from handeye_ros.config import Config
    from handeye_ros.data import Calibration
    from handeye_ros.sampling.session import Session
    from handeye_ros.sampling.trajectory import Trajectory
    from handeye_ros.tabulated.problem import TableProblem

file_option, folder_option, length_option = (
    partial(typer.Option, metavar=name) for name in ('FILE', 'DIR', 'L'))
OptionalPath = Optional[Path]  # noqa: UP045 - the typer of Jazzy does not know `Path | None`
Bag = Annotated[Path, typer.Argument(help='A rosbag2 folder, or an .mcap or .db3 file.')]
Input = Annotated[Path, typer.Argument(
    metavar='INPUT', help='A rosbag2 folder, or an .mcap or .db3 file; a session; for points and '
    'hand_eye a CSV file.')]
ConfigFile = Annotated[OptionalPath, typer.Option(
    help='A ROS parameter file, such as config/plate.yaml; without it, the defaults.')]
Assignments = Annotated[list[str], typer.Option('--set', metavar='KEY=VALUE', help=(
    'Set a key of the configuration, in SI units or as 20mm and 0.1deg; may be repeated.'))]
KinematicsFile = Annotated[OptionalPath, file_option(
    '--kinematics', help='A kinematics.yaml: its arm gives the poses from the joint values.')]
Angles = Annotated[str, typer.Option(
    metavar='NOTATION', help='How a table of poses writes orientations: kuka-abc, fanuc-wpr, '
    'abb-quaternion, ur-rotation-vector, staubli-rxryrz or yaskawa-rxryrz.')]
CalibrationFile = Annotated[Path, file_option(
    '--calibration', help='The calibration.yaml of this sensor, or its folder.')]
MeasureConfig = Annotated[OptionalPath, typer.Option(
    help='A ROS parameter file; without it, the settings that the calibration was made with.')]
OutFile = Annotated[OptionalPath, file_option(help='Write the result as YAML too.')]
INTERRUPTED_EXIT_CODE, BROKEN_PIPE_EXIT_CODE = 130, 141  # 128 + SIGINT, SIGPIPE


@dataclass(frozen=True, eq=False)
class OpenedInput:
    """
    The content of INPUT: the samples of a recording or of a session, or else a table.

    settings: the configuration with which it was read
    inputs: path and sha256 of its files, for the provenance of an answer
    session: the samples, None for a table
    warnings: the warnings about a recording, printed when it was read
    table: the measured values, None for a recording and for a session
    """

    settings: 'Config'
    inputs: 'Sequence[Any]'
    session: 'Session | None' = None
    warnings: 'Sequence[str]' = ()
    table: 'TableProblem | None' = None


def open_input(path: Path, config: Path | None, assignments: list[str], angles: str = '',
               kinematics: Path | None = None) -> OpenedInput:
    """
    Return what a bag, a session's folder or a table holds; print warnings about it.

    config, assignments, kinematics: the settings, as for `configuration`; those of a session are
    its own before. angles: the notation in which a table of poses writes orientations. Raises
    InputError for what cannot be read, and DataError for a recording that cannot be used.
    """
    from handeye_ros.bags.session_files import is_session, read_session
    from handeye_ros.config import SOLVED_FROM_FILES
    stored = read_session(path) if is_session(path) else None
    by_angles = [f'target.angles={angles}'] if angles else []
    settings = configuration(config, [*by_angles, *assignments], stored.config if stored else None,
                             kinematics)
    if angles and settings.target.type != 'hand_eye':
        raise InputError('--angles is for a table of poses, and target.type is '
                         f'{settings.target.type}: set it to hand_eye, or leave --angles out')
    if is_table(path) or settings.target.type in SOLVED_FROM_FILES:
        from handeye_ros import tabulated
        with progress_bar('reading the files'):
            table = tabulated.read_table(path, settings)
        warn(*table.warnings)
        return OpenedInput(settings, table.inputs, table=table)
    if stored:
        return OpenedInput(settings, [{'path': str(path.absolute())}], stored.session(settings))
    recording = open_bag(path, settings)
    return OpenedInput(settings, list(recording.inputs), collect_samples(recording, settings),
                       recording.warnings)


def configuration(file: Path | None, assignments: list[str], base: 'Config | None' = None,
                  kinematics: Path | None = None) -> 'Config':
    """
    Return settings with the keys of a file, and then those of assignments KEY=VALUE.

    base: the settings to begin with, the defaults where there are none. kinematics: a
    kinematics.yaml, whose frames are set too. Of a key that is set twice the last assignment
    counts. Raises InputError for a file that cannot be read, unknown keys and unusable values.
    """
    from handeye_ros.config import Config, load, with_assignments
    base = base or Config()
    if kinematics:
        from handeye_ros.results.kinematics_file import read_arm
        arm = read_arm(kinematics)
        assignments = [f'kinematics={kinematics.absolute()}', f'robot_base_frame={arm.base}',
                       f'robot_effector_frame={arm.flange}', *assignments]
    return with_assignments(load(file, base) if file else base, assignments)


def open_calibration(file: Path, config: Path | None, assignments: list[str],
                     kinematics: Path | None) -> 'tuple[Calibration, Config]':
    """
    Return a calibration, and the settings to measure with it.

    file: of the calibration, or its folder. config: a file of settings in place of those that the
    calibration was made with. Raises InputError for a file that cannot be used.
    """
    from handeye_ros.config import load
    from handeye_ros.results.calibration_file import config_to_measure, read_calibration
    calibration = read_calibration(file)
    settings = config_to_measure(calibration, load(config) if config else None)
    return calibration, configuration(None, assignments, settings, kinematics)


def is_table(path: Path) -> bool:
    """Return whether a path is a table of measured values, by its name."""
    return path.suffix == '.csv' and path.is_file()


def open_bag(bag: Path, settings: 'Config', arm: 'Arm | None' = None) -> 'Recording':
    """Return the messages of a bag, and print its warnings; an arm gives the poses from joints."""
    with progress_bar('reading the recording') as progress:
        from handeye_ros.bags.recording import read_bag
        recording = read_bag(bag, settings, progress, arm)
    warn(*recording.warnings)
    return recording


def collect_samples(recording: 'Recording', settings: 'Config') -> 'Session':
    """Return the session that the messages of a recording make; raises DataError."""
    with progress_bar('finding the samples'):
        from handeye_ros import pipeline
        return pipeline.gather(recording.profiles, recording.poses, settings)


def warn_of_frame(recording: 'Recording', calibration: 'Calibration') -> None:
    """Warn where the profiles are of another frame than the sensor of a calibration."""
    from handeye_ros.frames import frame_mismatch_warning
    frame = next((profile.frame_id for profile in recording.profiles), '')
    warn(frame_mismatch_warning(frame, calibration.child_frame))


@contextmanager
def stream_recording(bag: Path, settings: 'Config', calibration: 'Calibration'
                     ) -> 'Iterator[tuple[Recording, Trajectory]]':
    """
    Give a recording to scan, whose profiles are read one by one, and its poses.

    The stamps of the profiles are as recorded: what uses them adds the time offset.
    """
    from handeye_ros.bags.recording import read_bag
    from handeye_ros.sampling.trajectory import trajectory_of
    with progress_bar('scanning'):
        recording = read_bag(bag, replace(settings, time_offset=0.0))
        warn_of_frame(recording, calibration)
        yield recording, trajectory_of(recording.poses, settings.sampling.max_pose_gap)
    warn(*recording.warnings)


def warn(*warnings: str) -> None:
    """Print warnings, but empty ones."""
    for warning in filter(None, warnings):
        typer.echo(f'{WARNING_MARK}{warning}', err=True)


@contextmanager
def progress_bar(task: str) -> Iterator[Callable[[str | float], None]]:
    """
    Show a task on a terminal while the block runs.

    Gives a function that takes another name of the task, or the fraction of it that is done.
    """
    if not sys.stderr.isatty():
        yield lambda progress: None
        return
    from rich.console import Console
    from rich.progress import Progress
    with Progress(console=Console(stderr=True), transient=True) as bar:
        number = bar.add_task(task, total=None)
        yield lambda progress: (
            bar.update(number, description=progress) if isinstance(progress, str) else
            bar.update(number, total=1.0, completed=progress))


def show(renderable: Any) -> None:
    """Print a table of rich; where nobody reads the output any more, BrokenPipeError is raised."""
    from rich.console import Console
    console = Console()
    if not console.is_terminal:
        console = Console(width=160, color_system=None)  # a pipe has no width to wrap at
    with console.capture() as output:  # rich itself would end the process at a broken pipe
        console.print(renderable)
    typer.echo(output.get(), nl=False)


def require_html_name(path: Path) -> None:
    """Raise BadValueError for the name of a page that has the ending of another kind of file."""
    if path.suffix.lower() not in ('.html', '.htm'):
        raise BadValueError('the file of the page', str(path), 'a name that ends with .html (a '
                            'browser prints it as PDF)')


def write_yaml(file: Path | None, values: Any) -> None:
    """Write values as YAML, where a file is given; raises UnwritableError."""
    from handeye_ros.output import write_atomically, yaml_text
    if file:
        write_atomically(file, yaml_text(values))


class Verbs(TyperGroup):
    """The verbs, whose errors end with a sentence and an exit code instead of a traceback."""

    def invoke(self, ctx: Any) -> Any:
        """Run the verb of a command line."""
        try:
            return super().invoke(ctx)
        except HandeyeError as error:
            typer.echo(f'{ERROR_MARK}{" ".join(str(error).split())}', err=True)
            raise typer.Exit(error.exit_code) from None
        except BrokenPipeError:  # who reads the output has ended
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(BROKEN_PIPE_EXIT_CODE) from None
        except OSError as error:  # such as a full disk behind stdout
            typer.echo(f'{ERROR_MARK}{error}', err=True)
            raise typer.Exit(InputError.exit_code) from None
        except KeyboardInterrupt:
            raise typer.Exit(INTERRUPTED_EXIT_CODE) from None


app = typer.Typer(cls=Verbs, no_args_is_help=True, rich_markup_mode=None,
                  pretty_exceptions_enable=False)


def _print_version(requested: bool) -> None:
    if requested:
        typer.echo(f'handeye_ros {__version__}')
        raise typer.Exit


@app.callback()
def _options(version: Annotated[bool, typer.Option(
        '--version', callback=_print_version, is_eager=True,
        help='Print the version.')] = False) -> None:
    """Hand-eye calibration of laser line profilers."""
