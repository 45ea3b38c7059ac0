"""The verbs that find the transform, and put its estimators beside each other."""
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, TYPE_CHECKING

from handeye_ros.cli.common import (
    Angles,
    app,
    Assignments,
    ConfigFile,
    configuration,
    doing,
    Input,
    KinematicsFile,
    NoPath,
    read_bag,
    show,
    stored_session,
    warn,
    with_kinematics,
)
from handeye_ros.errors import TableForProfilesError
import typer

if TYPE_CHECKING:
    from handeye_ros.config import Config
    from handeye_ros.data import Array, Calibration
    from handeye_ros.files.method import FileMethod
    from handeye_ros.files.method import Input as Given
    from handeye_ros.ros.bags.bag import Recording
    from handeye_ros.ros.sessions.reading import Stored


TABLES = ('.csv', '.yaml', '.yml')
TableFile = Annotated[NoPath, typer.Option(metavar='FILE', help='Write the table as YAML too.')]


@app.command()
def solve(
    path: Input,
    config: ConfigFile = None,
    assignments: Assignments = [],  # noqa: B006 - never changed
    angles: Angles = '',
    kinematics: KinematicsFile = None,
    out: Annotated[NoPath, typer.Option(
        metavar='DIR', help='Where calibration.yaml is written; if not given, the folder NAME in '
                            'output_dir, or in out.')] = None,
) -> None:
    """Find the transform from a recording or a file, and write calibration.yaml."""
    stored = stored_session(path)
    assignments = with_kinematics(assignments, kinematics)
    settings = configuration(config, assignments, stored.config if stored else None, angles)
    folder = _target(out, settings)

    from handeye_ros.results import exports, table
    from handeye_ros.results.truth_file import errors_against, true_transform
    method, T_true = _file_method(path, settings), true_transform(path)
    calibration, field = (_solve_files(method, path, settings) if method else
                          (_solve_session(stored, settings) if stored else
                           _solve_bag(path, settings), None))
    saved = exports.save_all(calibration, folder, settings.save.formats)
    show(table.table(calibration))
    if T_true is not None:
        errors = errors_against(calibration.T_flange_sensor, T_true, field)
        typer.echo(table.error_sentence(errors, *([method.over] if method else [])))
    typer.echo(saved)


def _target(out: Path | None, settings: 'Config') -> Path:
    """Return the folder of the result, absolute."""
    from handeye_ros.output import folder_name
    return (out or Path(settings.output_dir or 'out') / folder_name(settings)).absolute()


def _file_method(path: Path, settings: 'Config') -> 'FileMethod[Any] | None':
    """Return the method of a target that is solved from files, None for one seen by profiles."""
    from handeye_ros import files
    method = files.of(settings)
    if method is None and path.suffix in TABLES and path.is_file():
        raise TableForProfilesError(path, settings.target.type, list(files.FILE_METHODS))
    return method


def _solve_session(stored: 'Stored', settings: 'Config') -> 'Calibration':
    with doing('solving'):
        from handeye_ros import pipeline
        calibration = pipeline.calibrate_session(stored.session(settings), settings)
    return _with_inputs(calibration, [{'path': str(stored.path)}])


def _solve_bag(bag: Path, settings: 'Config') -> 'Calibration':
    recording = read_bag(bag, settings)
    with doing('solving'):
        from handeye_ros import pipeline
        calibration = pipeline.calibrate(recording.profiles, recording.poses, settings)
    return _with_inputs(calibration, list(recording.inputs))


def _with_inputs(calibration: 'Calibration', inputs: list[dict[str, str]]) -> 'Calibration':
    """Return a calibration that says what it came from; tell what was odd."""
    for warning in calibration.provenance.get('warnings', ()):
        warn(warning)
    return replace(calibration, provenance={**calibration.provenance, 'inputs': inputs})


def _read_files(method: 'FileMethod[Any]', path: Path, settings: 'Config'
                ) -> 'Given[Any]':
    def read(bag: Path, settings: 'Config') -> 'Recording':
        from handeye_ros.ros.bags import bag as bags
        return bags.read(bag, settings)

    with doing('reading the files'):
        given = method.read(path, settings, read)
    for warning in given.warnings:
        warn(warning)
    return given


def _solve_files(method: 'FileMethod[Any]', path: Path, settings: 'Config'
                 ) -> tuple['Calibration', 'Array']:
    """Return the calibration, and the points over which its errors are reported."""
    given = _read_files(method, path, settings)
    with doing('solving'):
        from handeye_ros.files.method import calibrate
        return calibrate(method, given, settings), method.field(given.data)


@app.command()
def compare(
    path: Input,
    config: ConfigFile = None,
    assignments: Assignments = [],  # noqa: B006 - never changed
    angles: Angles = '',
    out: TableFile = None,
) -> None:
    """Put the same samples through every estimator that applies, ours and published ones."""
    settings = configuration(config, assignments, angles=angles)

    from handeye_ros.comparison import compare as comparing
    from handeye_ros.comparison import table
    from handeye_ros.output import write_whole
    from handeye_ros.results.truth_file import true_transform
    import yaml
    method, T_true = _file_method(path, settings), true_transform(path)
    if method:
        given = _read_files(method, path, settings)
        with doing('solving') as now:
            found = comparing.compare_files(method, given, settings, T_true, progress=now)
    else:
        recording = read_bag(path, settings)
        with doing('finding the samples') as now:
            found = comparing.compare_recording(recording.profiles, recording.poses, settings,
                                                T_true, progress=now)
    if found.answered:
        show(table.ComparisonTable(found))
    if found.refusal:
        raise found.refusal
    if out:
        write_whole(out, yaml.safe_dump(table.values(found), sort_keys=False))
