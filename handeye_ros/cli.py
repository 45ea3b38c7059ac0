"""
The command `handeye`: every verb wraps one function of the library.

The heavy imports are inside the verbs, so that help and wrong usage answer at once, and so
that only `replay` imports ROS. No `from __future__ import annotations`: the typer of Jazzy
(0.9) would not see what is annotated.
"""
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
import sys
from typing import Annotated, Any, Optional, TYPE_CHECKING

from handeye_ros import __version__
from handeye_ros.errors import HandeyeError, NoRosError, UnknownNameError
import typer
from typer.core import TyperGroup

if TYPE_CHECKING:
    from handeye_ros.config import Config
    from handeye_ros.data import Array, Calibration
    from handeye_ros.files.method import FileMethod
    from handeye_ros.files.method import Input as Given
    from handeye_ros.ros.bags.bag import Recording

INTERRUPTED = 130


class Verbs(TyperGroup):
    """The one place where errors become a sentence and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        """Run a verb."""
        try:
            return super().invoke(ctx)
        except HandeyeError as error:
            typer.echo(f'error: {" ".join(str(error).split())}', err=True)
            raise typer.Exit(error.exit_code) from None
        except KeyboardInterrupt:
            raise typer.Exit(INTERRUPTED) from None


app = typer.Typer(cls=Verbs, add_completion=False, no_args_is_help=True, rich_markup_mode=None,
                  pretty_exceptions_enable=False)

NoPath = Optional[Path]  # noqa: UP045 - the typer of Jazzy does not know `Path | None`
Bag = Annotated[Path, typer.Argument(help='A rosbag2 folder, or an .mcap or .db3 file.')]
Input = Annotated[Path, typer.Argument(metavar='INPUT', help=(
    'A bag: a rosbag2 folder, or an .mcap or .db3 file; for points and hand_eye a CSV or YAML '
    'file.'))]
ConfigFile = Annotated[NoPath, typer.Option(
    help='A ROS parameter file, such as config/plate.yaml; without it, the defaults.')]
Assignments = Annotated[list[str], typer.Option(
    '--set', metavar='KEY=VALUE', help='Set a key of the configuration; may be repeated.')]


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f'handeye_ros {__version__}')
        raise typer.Exit


@app.callback()
def _options(version: Annotated[bool, typer.Option(
        '--version', callback=_print_version, is_eager=True,
        help='Print the version and exit.')] = False) -> None:
    """Hand-eye calibration of laser line profilers."""


@app.command()
def solve(
    path: Input,
    config: ConfigFile = None,
    assignments: Assignments = [],  # noqa: B006 - never changed
    out: Annotated[NoPath, typer.Option(
        metavar='DIR', help='Where calibration.yaml is written; out/NAME if not given.')] = None,
) -> None:
    """Find the transform from a recording or a file, and write calibration.yaml."""
    settings = _configuration(config, assignments)
    target = _target(out, settings) / 'calibration.yaml'

    from handeye_ros import files
    from handeye_ros.results import calibration_file, table
    from handeye_ros.results.truth_errors import errors_against
    from handeye_ros.results.truth_file import true_transform
    method, T_true = files.of(settings), true_transform(path)
    calibration, field = (_solve_files(method, path, settings) if method else
                          (_solve_bag(path, settings), None))
    calibration_file.write_calibration(calibration, target)
    _print(table.table(calibration))
    if T_true is not None:
        errors = errors_against(calibration.T_flange_sensor, T_true, field)
        typer.echo(table.error_sentence(errors, *([method.over] if method else [])))
    typer.echo(f'wrote {target}')


def _configuration(file: Path | None, assignments: list[str]) -> 'Config':
    from handeye_ros.config import Config, load, with_assignments
    return with_assignments(load(file) if file else Config(), assignments)


def _target(out: Path | None, settings: 'Config') -> Path:
    """Return the folder of the result, absolute."""
    from handeye_ros.results.calibration_file import folder_name
    return (out or Path('out') / folder_name(settings)).absolute()


def _read(bag: Path, settings: 'Config') -> 'Recording':
    with _doing('reading the recording'):
        from handeye_ros.ros.bags.bag import read
        recording = read(bag, settings)
    for warning in recording.warnings:
        typer.echo(f'warning: {warning}', err=True)
    return recording


def _solve_bag(bag: Path, settings: 'Config') -> 'Calibration':
    recording = _read(bag, settings)
    with _doing('solving'):
        from handeye_ros import pipeline
        calibration = pipeline.calibrate(recording.profiles, recording.poses, settings)
    for warning in calibration.provenance.get('warnings', ()):
        typer.echo(f'warning: {warning}', err=True)
    provenance = {**calibration.provenance, 'inputs': list(recording.inputs)}
    return replace(calibration, provenance=provenance)


def _read_files(method: 'FileMethod[Any]', path: Path, settings: 'Config'
                ) -> 'Given[Any]':
    def read_bag(bag: Path, settings: 'Config') -> 'Recording':
        from handeye_ros.ros.bags.bag import read
        return read(bag, settings)

    with _doing('reading the files'):
        given = method.read(path, settings, read_bag)
    for warning in given.warnings:
        typer.echo(f'warning: {warning}', err=True)
    return given


def _solve_files(method: 'FileMethod[Any]', path: Path, settings: 'Config'
                 ) -> tuple['Calibration', 'Array']:
    """Return the calibration, and the points over which its errors are told."""
    given = _read_files(method, path, settings)
    with _doing('solving'):
        from handeye_ros.files.outcome import calibrate
        return calibrate(method, given, settings), method.field(given.data)


@contextmanager
def _doing(what: str) -> Iterator[Callable[[str], None]]:
    """Show on a terminal what takes its time, and what it yields is told; quiet in a pipe."""
    if not sys.stderr.isatty():
        yield lambda now: None
        return
    from rich.console import Console
    with Console(stderr=True).status(what) as status:
        yield status.update


def _print(renderable: Any) -> None:
    from rich.console import Console
    console = Console()
    if not console.is_terminal:
        console = Console(width=160, color_system=None)  # a pipe has no width to wrap at
    console.print(renderable)


@app.command()
def compare(
    path: Input,
    config: ConfigFile = None,
    assignments: Assignments = [],  # noqa: B006 - never changed
) -> None:
    """Put the same samples through every estimator that applies, ours and published ones."""
    settings = _configuration(config, assignments)

    from handeye_ros import files
    from handeye_ros.comparison import compare as comparing
    from handeye_ros.comparison import table
    from handeye_ros.results.truth_file import true_transform
    method, T_true = files.of(settings), true_transform(path)
    if method:
        given = _read_files(method, path, settings)
        with _doing('solving') as now:
            found = comparing.compare_files(method, given, settings, T_true, progress=now)
    else:
        recording = _read(path, settings)
        with _doing('finding the samples') as now:
            found = comparing.compare_recording(recording.profiles, recording.poses, settings,
                                                T_true, progress=now)
    if found.answered:
        _print(table.ComparisonTable(found))
    if found.refusal:
        raise found.refusal


@app.command()
def replay(
    bag: Bag,
    rate: Annotated[float, typer.Option(help='Speed; 1 is as recorded.')] = 1.0,
) -> None:
    """Publish a recording on its topics, with /clock (needs ROS)."""
    try:
        from handeye_ros.ros.replay import replay as publish
    except ModuleNotFoundError as error:
        raise NoRosError('replay', str(error.name)) from error
    publish(bag, rate)


@app.command()
def simulate(
    scenario: Annotated[str, typer.Argument(help='The name of a scenario; see the README.')],
    directory: Annotated[Path, typer.Argument(
        metavar='DIR', help='The folder to make: a bag, or files of measured values.')],
    seed: Annotated[int, typer.Option(min=0, help='Of all random numbers.')] = 0,
    force: Annotated[bool, typer.Option('--force', help='Replace a bag that is there.')] = False,
) -> None:
    """Make a recording with a known answer, which is written to truth.yaml in it."""
    from handeye_ros.simulate import FILE_SCENES, SCENARIOS
    if scenario not in {*SCENARIOS, *FILE_SCENES}:
        raise UnknownNameError('scenario', scenario, [*SCENARIOS, *FILE_SCENES])

    from handeye_ros.ros.bags import simulated
    with _doing('simulating'):
        made = simulated.write(scenario, seed, directory, force)
    typer.echo(f'wrote {directory.absolute()}: {made}')


def main() -> None:
    """Run the console script `handeye`; ends the process with its exit code."""
    # an answer must not be lost to a terminal that lacks a letter of it
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, 'reconfigure'):
            stream.reconfigure(errors='replace')
    app(prog_name='handeye')
