"""The verbs that find the transform, and compare its estimators."""
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
    TABLES,
    warn,
    with_kinematics,
)
from handeye_ros.errors import TableForProfilesError
import typer

if TYPE_CHECKING:
    from handeye_ros.bags.bag import Recording
    from handeye_ros.bags.session_reading import Stored
    from handeye_ros.config import Config
    from handeye_ros.data import Array, Calibration
    from handeye_ros.tabulated.method import FileMethod
    from handeye_ros.tabulated.method import Input as Given


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

    from handeye_ros.output import folder_name
    from handeye_ros.results import exports, table
    from handeye_ros.results.truth_file import errors_against, true_transform
    folder = out or Path(settings.output_dir or 'out') / folder_name(settings)
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


def _file_method(path: Path, settings: 'Config') -> 'FileMethod[Any] | None':
    """Return the method of a target that is solved from files, None for one of profiles."""
    from handeye_ros import tabulated
    method = tabulated.of(settings)
    if method is None and path.suffix in TABLES and path.is_file():
        raise TableForProfilesError(path, settings.target.type, list(tabulated.FILE_METHODS))
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
    """Return a calibration with its inputs in the provenance; print its warnings."""
    for warning in calibration.provenance.get('warnings', ()):
        warn(warning)
    return replace(calibration, provenance={**calibration.provenance, 'inputs': inputs})


def _read_files(method: 'FileMethod[Any]', path: Path, settings: 'Config'
                ) -> 'Given[Any]':
    def read(bag: Path, settings: 'Config') -> 'Recording':
        from handeye_ros.bags import bag as bags
        return bags.read(bag, settings)

    with doing('reading the files'):
        content = method.read(path, settings, read)
    for warning in content.warnings:
        warn(warning)
    return content


def _solve_files(method: 'FileMethod[Any]', path: Path, settings: 'Config'
                 ) -> tuple['Calibration', 'Array']:
    """Return the calibration, and the points over which its errors are reported."""
    content = _read_files(method, path, settings)
    with doing('solving'):
        from handeye_ros.tabulated.method import calibrate
        return calibrate(method, content, settings), method.field(content.data)


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

    from handeye_ros.output import write_whole
    from handeye_ros.published import compare as comparing
    from handeye_ros.published import table
    from handeye_ros.results.truth_file import true_transform
    import yaml
    method, T_true = _file_method(path, settings), true_transform(path)
    if method:
        content = _read_files(method, path, settings)
        with doing('solving') as update:
            comparison = comparing.compare_files(method, content, settings, T_true,
                                                 progress=update)
    else:
        recording = read_bag(path, settings)
        with doing('finding the samples') as update:
            comparison = comparing.compare_recording(recording.profiles, recording.poses, settings,
                                                     T_true, progress=update)
    if comparison.answered:
        show(table.ComparisonTable(comparison))
    if comparison.refusal:
        raise comparison.refusal
    if out:
        write_whole(out, yaml.safe_dump(table.values(comparison), sort_keys=False))
