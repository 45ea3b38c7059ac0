# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The verbs about the transform: find, compare, show and export it; its samples; the node.

And the one that finds the errors of the arm with it.
"""
from dataclasses import replace
from importlib.util import find_spec
import json
import os
from pathlib import Path
import sys
from typing import Annotated

from handeye_ros.cli.common import (
    Angles,
    app,
    Assignments,
    collect_samples,
    ConfigFile,
    configuration,
    file_option,
    folder_option,
    Input,
    is_table,
    KinematicsFile,
    open_bag,
    open_input,
    OptionalPath,
    OutFile,
    progress_bar,
    require_html_name,
    show,
    warn,
    write_yaml,
)
from handeye_ros.config import assignment, RECORD_PREFIX, SAVE_FORMATS
from handeye_ros.errors import InputError, looked_up, NoRosError
import typer


@app.command()
def solve(
    path: Input,
    config: ConfigFile = None,
    assignments: Assignments = [],
    angles: Angles = '',
    kinematics: KinematicsFile = None,
    out: Annotated[OptionalPath, folder_option(
        help='For calibration.yaml; default: the folder NAME in output_dir, or in out.')] = None,
    budget: Annotated[bool, typer.Option(
        '--budget', help='Show what the uncertainty comes from too.')] = False,
) -> None:
    """Find the transform from a recording or a file."""
    from handeye_ros.output import folder_name
    from handeye_ros.results import exports, printed
    from handeye_ros.results.truth import errors_against, FIELD_TEXT, true_transform
    opened = open_input(path, config, assignments, angles, kinematics)
    settings = opened.settings
    folder = out or Path(settings.output_dir or 'out') / folder_name(settings)
    T_true = true_transform(path, bool(settings.kinematics))
    if opened.table:
        from handeye_ros.tabulated.problem import calibrate_table
        if budget:
            raise InputError('--budget is of the profiles of a recording; the answer from a table '
                             'states its covariance only')
        with progress_bar('solving'):
            calibration = calibrate_table(opened.table)
        T_plane, points = opened.table.T_sensor_plane, opened.table.error_points()
        points_text = opened.table.error_points_text
    else:
        assert opened.session
        from handeye_ros import pipeline
        from handeye_ros.estimation.budget import budget as budget_of
        from handeye_ros.frames import T_sensor_plane
        with progress_bar('solving'):
            answer = pipeline.answer_session(opened.session, settings)
        if budget and answer.samples_agree:
            solution = answer.require_solution()
            show(printed.budget_table(budget_of(solution), len(solution.used_stations)))
        calibration = answer.require_calibration()
        warnings = calibration.provenance.get('warnings', ())
        warn(*warnings)
        provenance = {**calibration.provenance, 'inputs': opened.inputs}
        if opened.warnings:
            provenance['warnings'] = [*opened.warnings, *warnings]
        calibration = replace(calibration, provenance=provenance)
        T_plane, points, points_text = T_sensor_plane(settings), None, FIELD_TEXT
    saved = exports.save_all(calibration, folder, settings.save.formats)
    show(printed.table(calibration))
    if T_true is not None:
        errors = errors_against(calibration.T_flange_sensor @ T_plane, T_true @ T_plane, points)
        typer.echo(printed.error_sentence(errors, points_text))
    typer.echo(saved)


@app.command()
def calibrate(
    resume: Annotated[bool, typer.Option('--resume', help='Continue the last session.')] = False,
    config: ConfigFile = None,
    assignments: Assignments = [],
) -> None:
    """Start the node that takes samples (needs ROS)."""
    configuration(config, assignments)  # so that a mistake is reported at once
    if find_spec('rclpy') is None:
        raise NoRosError('calibrate', 'rclpy')
    command = [sys.executable, '-m', 'handeye_ros.node.calibrate', '--ros-args']
    command += ['--params-file', str(config)] if config else []
    for text in (*assignments, *(['session=last'] if resume else [])):
        key, value = assignment(text)
        is_text = key.startswith(RECORD_PREFIX) or not value  # ROS reads any other as YAML
        command += ['-p', f'{key}:={json.dumps(value) if is_text else value}']
    os.execv(sys.executable, command)


@app.command()
def samples(
    path: Annotated[Path, typer.Argument(
        metavar='SESSION', help='The folder of a session, or a bag.')],
    config: ConfigFile = None,
    assignments: Assignments = [],
) -> None:
    """Show the samples of a session, the worst first."""
    from handeye_ros import pipeline
    from handeye_ros.review import samples_table
    opened = open_input(path, config, assignments)
    settings, session = opened.settings, opened.session
    if session is None:
        raise InputError(f'{path} is a table of measured values, without samples')
    with progress_bar('comparing the samples'):
        answer = pipeline.answer_session(session, settings)
        rows = samples_table(session, answer)
    if answer.refusal:
        typer.echo(f'refused: {answer.refusal}', err=True)
    show(rows)


@app.command()
def report(
    path: Annotated[Path, typer.Argument(
        metavar='RESULT', help='The file of a calibration, or its folder, or of a verification.')],
    bag: Annotated[OptionalPath, typer.Option(
        metavar='BAG', help='The recording or session; default: as the calibration says.')] = None,
    out: Annotated[OptionalPath, file_option(help='Default: a page beside the file.')] = None,
) -> None:
    """Show a calibration or verification in one HTML file."""
    from handeye_ros.output import write_atomically
    from handeye_ros.results import exports
    from handeye_ros.results.calibration_file import file_of, read_calibration
    from handeye_ros.results.report import disagreement, html
    from handeye_ros.review import solved_recording
    from handeye_ros.verification.result_file import protocol_of
    if out:
        require_html_name(out)
    text = protocol_of(path) if path.is_file() else None
    if text is not None:
        page = path.with_suffix('.html')
    else:
        file = file_of(path)
        page, calibration = file.parent / exports.REPORT_FILE, read_calibration(file)
        with progress_bar('writing the report'):
            shown = solved_recording(calibration, bag, file.parent)
            text = html(calibration, shown)
        warn(disagreement(calibration, shown))
    page = (out or page).expanduser().absolute()
    write_atomically(page, text)
    typer.echo(f'wrote {page}')


@app.command()
def export(
    path: Annotated[Path, typer.Argument(
        metavar='CALIBRATION', help='A calibration.yaml, or the folder that holds it.')],
    name: Annotated[str, typer.Option(
        '--format', autocompletion=lambda: list(SAVE_FORMATS),
        help=f'One of {", ".join(SAVE_FORMATS)}.')],
    out: Annotated[OptionalPath, file_option(
        help='The file to write, - for the screen; default: beside the calibration.')] = None,
) -> None:
    """Write a saved calibration for other programs."""
    from handeye_ros.results import exports
    from handeye_ros.results.calibration_file import file_of, read_calibration
    form, file = looked_up('format', name, exports.FORMATS), file_of(path)
    calibration = read_calibration(file)
    if str(out) == '-':
        typer.echo(form.text(calibration), nl=False)
        return
    target = out or file.parent / form.file_name(calibration)
    typer.echo(exports.export(calibration, name, target))


@app.command()
def compare(
    path: Input,
    config: ConfigFile = None,
    assignments: Assignments = [],
    angles: Angles = '',
    out: OutFile = None,
) -> None:
    """Compare the estimators on the same samples."""
    from handeye_ros import compare as comparing
    from handeye_ros.results.truth import true_transform
    opened = open_input(path, config, assignments, angles)
    T_true = true_transform(path, bool(opened.settings.kinematics))
    with progress_bar('comparing'):
        if opened.table:
            comparison = comparing.compare_files(opened.table, T_true)
        else:
            assert opened.session
            comparison = comparing.compare(
                opened.session.samples, opened.session.rejects, opened.settings, T_true,
                session=opened.session)
    show(comparing.tables(comparison))
    if comparison.refusal:
        raise comparison.refusal
    write_yaml(out, comparing.plain_values(comparison))


@app.command()
def kinematics(
    sources: Annotated[list[Path], typer.Argument(metavar='SOURCE...', help=(
        'Bags with profiles and joint values, or sessions, each with the target at another place; '
        'or a table of joint values and measured points (CSV). State the target, as in --set '
        'target.type=sphere.'))],
    urdf: Annotated[Path, file_option(help='The URDF of the robot.')],
    base: Annotated[str, typer.Option(help='Link of its base; default: the root.')] = '',
    flange: Annotated[str, typer.Option(
        help='Link of the sensor; default: tool0, flange, or the last.')] = '',
    config: ConfigFile = None,
    assignments: Assignments = [],
    out: Annotated[Path, folder_option(
        help='For corrected.urdf, kinematics.yaml, calibration.yaml.')] = Path('out/kinematics'),
) -> None:
    """Estimate the errors of the arm, with the transform."""
    tables = [*filter(is_table, sources)]
    if tables and len(sources) > 1:
        raise typer.BadParameter('give one table only; its column "target" names the points')
    if len({path.resolve() for path in sources}) < len(sources):
        raise typer.BadParameter('give each source once: it would count twice')
    settings = configuration(config, assignments)
    from handeye_ros.arm import read_urdf
    from handeye_ros.bags.session_files import is_session, read_session
    from handeye_ros.results.file_values import input_provenance
    from handeye_ros.robot.answer import table
    from handeye_ros.robot.from_recordings import arm_samples_of, solve_samples
    from handeye_ros.robot.from_table import solve_table
    text, arm = read_urdf(urdf, base, flange)
    if tables:
        with progress_bar('solving'):
            answer = solve_table(tables[0], arm, settings,
                                 [*map(input_provenance, (*tables, urdf))])
    else:
        measured = []
        for path in sources:
            stored = read_session(path) if is_session(path) else None
            read_with = replace(configuration(
                config, assignments, stored.config if stored else None), kinematics='')
            recording = open_bag(path, read_with, arm)
            measured.append(arm_samples_of(
                stored.session(read_with) if stored else collect_samples(recording, read_with),
                recording, arm, read_with,
                [{'path': str(path.absolute())}] if stored else recording.inputs))
        with progress_bar('solving'):
            answer = solve_samples(measured, arm, [input_provenance(urdf)])
    warn(*answer.warnings)
    show(table(answer))
    typer.echo(answer.save(text, out, settings.save.formats))
