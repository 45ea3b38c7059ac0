# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The transform, by the estimator or by all of them; the samples; the node that takes them."""
from dataclasses import replace
from importlib.util import find_spec
import os
from pathlib import Path
import sys
from typing import Annotated, TYPE_CHECKING

from handeye_ros.cli.common import (
    Angles,
    app,
    Assignments,
    ConfigFile,
    configuration,
    doing,
    gathered,
    Input,
    KinematicsFile,
    NoPath,
    OutFile,
    read_bag,
    show,
    stored_session,
    TABLES,
    warn,
    with_kinematics,
)
from handeye_ros.errors import InputError, NoRosError
import typer

if TYPE_CHECKING:
    from handeye_ros.config import Config
    from handeye_ros.tabulated.method import FileMethod
    from handeye_ros.tabulated.method import Input as Given


@app.command()
def solve(
    path: Input,
    config: ConfigFile = None,
    assignments: Assignments = [],
    angles: Angles = '',
    kinematics: KinematicsFile = None,
    out: Annotated[NoPath, typer.Option(
        metavar='DIR', help='Where calibration.yaml is written; if not given, the folder NAME in '
                            'output_dir, or in out.')] = None,
    budget: Annotated[bool, typer.Option(
        '--budget', help='Also show which causes the uncertainty comes from.')] = False,
) -> None:
    """Find the transform from a recording or a file."""
    stored = stored_session(path)
    settings = configuration(config, with_kinematics(assignments, kinematics),
                             stored.config if stored else None, angles)

    from handeye_ros.output import folder_name
    from handeye_ros.results import exports, table
    from handeye_ros.results.truth_file import errors_against, true_transform
    folder = out or Path(settings.output_dir or 'out') / folder_name(settings)
    method, T_true, field = _file_method(path, settings), true_transform(path), None
    causes = None
    if method:
        if budget:
            raise InputError('--budget is of the profiles of a recording; the answer from a table '
                             'states its covariance only')
        from handeye_ros.tabulated.method import calibrate as calibrate_files
        content = _read_files(method, path, settings)
        with doing('solving'):
            calibration = calibrate_files(method, content, settings)
        field = content.values.field()
    else:
        from handeye_ros import pipeline
        from handeye_ros.estimation.covariance import budget as budget_of
        if stored:
            session, inputs = stored.session(settings), [{'path': str(path.absolute())}]
        else:
            recording = read_bag(path, settings)
            session = pipeline.gather(recording.profiles, recording.poses, settings)
            inputs = list(recording.inputs)
        with doing('solving'):
            answer = pipeline.answer_of(session, settings)
            calibration = answer.required()
            causes = budget_of(answer.consensus()) if budget else None
        for warning in calibration.provenance.get('warnings', ()):
            warn(warning)
        calibration = replace(calibration,
                              provenance={**calibration.provenance, 'inputs': inputs})
    saved = exports.save_all(calibration, folder, settings.save.formats)
    show(table.table(calibration))
    if causes:
        show(table.budget_table([(term.name, term.mapped, term.translation, term.rotation)
                                 for term in (*causes.terms, causes.total)], causes.samples))
    if T_true is not None:
        errors = errors_against(calibration.T_flange_sensor, T_true, field)
        typer.echo(table.error_sentence(errors, *([method.over] if method else [])))
    typer.echo(saved)


def _file_method(path: Path, settings: 'Config') -> 'FileMethod | None':
    """Return the method of a target that is solved from files, None for one of profiles."""
    from handeye_ros.targets import METHODS
    is_table = path.suffix in TABLES and path.is_file()
    if settings.target.type in METHODS and not is_table:
        return None
    from handeye_ros import tabulated
    method = tabulated.of(settings)
    if method is None and is_table:
        fitting = list(tabulated.FILE_METHODS)
        raise InputError(f'{path} is a table of measured values, but target.type '
                         f'{settings.target.type} is seen by the profiles of a recording: set '
                         f'target.type to {" or ".join(fitting)}, as in --set '
                         f'target.type={fitting[0]}')
    return method


def _read_files(method: 'FileMethod', path: Path, settings: 'Config') -> 'Given':
    with doing('reading the files'):
        content = method.read(path, settings)
    for warning in content.warnings:
        warn(warning)
    return content


@app.command()
def compare(
    path: Input,
    config: ConfigFile = None,
    assignments: Assignments = [],
    angles: Angles = '',
    out: OutFile = None,
) -> None:
    """Put the same samples through all estimators."""
    stored = stored_session(path)
    settings = configuration(config, assignments, stored.config if stored else None, angles)

    from handeye_ros.output import write_whole
    from handeye_ros.published import compare as comparing
    from handeye_ros.results.truth_file import true_transform
    import yaml
    method, T_true = _file_method(path, settings), true_transform(path)
    if method:
        content = _read_files(method, path, settings)
        with doing('solving') as update:
            comparison = comparing.compare_files(method, content, settings, T_true,
                                                 progress=update)
    else:
        settings = comparing.own_method(settings)
        session = stored.session(settings) if stored else gathered(path, settings)
        with doing('comparing') as update:
            comparison = comparing.compare(session.samples, session.rejects, settings, T_true,
                                           progress=update)
    show(comparing.tables(comparison))
    if comparison.refusal:
        raise comparison.refusal
    if out:
        write_whole(out, yaml.safe_dump(comparing.values(comparison), sort_keys=False))


@app.command()
def samples(
    path: Annotated[Path, typer.Argument(metavar='SESSION', help=(
        'The folder of a session, or a bag.'))],
    config: ConfigFile = None,
    assignments: Assignments = [],
) -> None:
    """Show the samples of a session, the worst first."""
    from handeye_ros import pipeline
    from handeye_ros.evidence import agreements, sample_summary
    from rich import box
    from rich.table import Table
    stored = stored_session(path)
    settings = configuration(config, assignments, stored.config if stored else None)
    session = stored.session(settings) if stored else gathered(path, settings)
    outcomes = [outcome for outcome in session.outcomes if outcome.sample]
    with doing('comparing the samples'):
        answer = pipeline.answer(session.samples, session.rejects, session.with_base(settings),
                                 session.frame_id)
        found = agreements(answer, [o.sample for o in outcomes if o.sample], settings)
    if answer.refusal:
        typer.echo(f'{"refused" if answer.solution else "no residuals yet"}: {answer.refusal}',
                   err=True)
    residuals = {o.number: (a.residual, a.left_out, a.used)
                 for o, a in zip(outcomes, found, strict=True) if a}

    table = Table(*[''] * 5, box=box.SIMPLE_HEAD, pad_edge=False)
    for column, name in zip(table.columns, ('number', 'residual', 'left out'), strict=False):
        column.header, column.justify = name, 'right'
    for outcome in sorted(session.outcomes, key=lambda o: (
            -residuals.get(o.number, (0.0, -1.0))[1], o.number)):
        residual, left_out, used = residuals.get(outcome.number, (None, None, True))
        state = 'left out' if session.excludes(outcome) else '' if used else 'not believed'
        table.add_row(
            str(outcome.number), *('' if value is None else f'{value * 1e3:.3f} mm'
                                   for value in (residual, left_out)),
            'no sample' if outcome.sample is None else state, sample_summary(outcome.result))
    show(table)


@app.command()
def calibrate(
    resume: Annotated[bool, typer.Option(
        '--resume', help='Continue the last session; the default is a new one.')] = False,
    config: ConfigFile = None,
    assignments: Assignments = [],
) -> None:
    """Start the node that takes samples (needs ROS)."""
    from handeye_ros.units import assigned
    configuration(config, assignments)  # so that a mistake is reported at once
    if find_spec('rclpy') is None:
        raise NoRosError('calibrate', 'rclpy')
    arguments = ['--params-file', str(config)] if config else []
    for text in [*map(assigned, assignments), *(['session=last'] if resume else [])]:
        key, _, value = text.partition('=')
        arguments += ['-p', f'{key.strip()}:={value}']
    command = [sys.executable, '-m', 'handeye_ros.node']
    os.execv(sys.executable, [*command, *(['--ros-args', *arguments] if arguments else [])])
