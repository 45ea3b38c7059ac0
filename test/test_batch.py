# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Many recordings through one verb: rows, what is computed again, and what a lost worker costs."""
from __future__ import annotations

import csv
from dataclasses import replace
import inspect
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import get_args

from calibrations import CALIBRATION
from command import assert_refused, handeye, PATIENCE, ROOT
from handeye_ros.batch import (
    arguments_of,
    CRASH_EXIT_CODE,
    earlier_row,
    Job,
    job_rows,
    jobs_of,
    OUTPUTS,
    PATH_KEYS,
    PATH_OPTIONS,
    run,
    write_table,
)
from handeye_ros.cli import command
from handeye_ros.cli.common import warn
from handeye_ros.config import parameters
from handeye_ros.errors import InputError
from handeye_ros.results.calibration_file import write_calibration
import numpy as np
import pytest
from typer.models import OptionInfo

pytest.importorskip('distributed', reason='needs distributed')


def pretended(arguments: list[str]) -> int:
    """Do as `handeye solve` does, by what the recording holds."""
    bag, out = Path(arguments[1]), Path(arguments[arguments.index('--out') + 1])
    text = bag.read_text()
    if text == 'kill':
        os._exit(9)
    if text == 'crash':
        raise ZeroDivisionError('a fault')
    if text == 'misuse':
        print('Usage: handeye solve\n\nError: No such option: --x', file=sys.stderr)
        return 2
    if text == 'doubt':
        (out / 'verification.yaml').write_text('verdict: insensitive\n')
        return 1
    if text == 'refuse':
        print('error: no target was seen within 3.1 mm', file=sys.stderr)
        return 3
    sensor, x, *warnings = text.split(maxsplit=2)
    warn(*warnings)
    T = np.eye(4)
    T[0, 3] = float(x)
    write_calibration(replace(CALIBRATION, child_frame=sensor, T_flange_sensor=T),
                      out / 'calibration.yaml')
    return 0


def test_each_job_costs_itself_and_is_computed_once(tmp_path):
    texts = {f'good{k}': f'laser {k}e-3' for k in range(6)}
    texts |= {'killing': 'kill', 'crashing': 'crash', 'refused': 'refuse', 'misused': 'misuse',
              'doubtful': 'doubt', 'warned': 'laser 0.0 the poses are rare'}
    for name, text in texts.items():
        (tmp_path / f'{name}.mcap').write_text(text)
    out, jobs = tmp_path / 'out', jobs_of([str(tmp_path)], 'solve')
    assert [job.label for job in jobs] == sorted(texts)
    rows = {row['label']: row for row in job_rows(jobs, out, pretended)}
    assert {name: row['exit_code'] for name, row in rows.items() if row['exit_code']} == {
        'killing': CRASH_EXIT_CODE, 'crashing': CRASH_EXIT_CODE, 'refused': 3, 'misused': 2,
        'doubtful': 1}
    assert rows['crashing']['cause'] == 'ZeroDivisionError: a fault'
    assert 'worker' in rows['killing']['cause'].lower()
    assert rows['misused']['cause'] == 'No such option: --x'
    assert rows['warned']['warnings'] == 1 and rows['good5']['warnings'] == 0
    assert rows['good5']['x'] == 5e-3 and rows['good5']['qw'] == 1.0
    assert rows['good5']['std_x'] == CALIBRATION.covariance[0, 0] ** 0.5
    assert rows['good5']['residual_rms'] == CALIBRATION.quality.residual_rms
    (tmp_path / 'good3.mcap').write_text('laser 3.0')
    computed_again = {job.label for job in jobs if earlier_row(job, out) is None}
    assert computed_again == {'good3', 'killing', 'crashing'}
    write_table([*rows.values()], out)
    with (out / 'results.csv').open() as stream:
        assert [row['label'] for row in csv.DictReader(stream)] == sorted(rows)
    page = (out / 'report.html').read_text()
    assert 'no target was seen within 3.1 mm' in page and 'good5/output.txt' in page
    assert '<td>insensitive</td>' in page


def test_links_to_recordings_are_followed(tmp_path):
    (tmp_path / 'store/night').mkdir(parents=True)
    (tmp_path / 'store/night/metadata.yaml').touch()
    (tmp_path / 'store/night/up').symlink_to(tmp_path / 'store')  # back, and not for ever
    (tmp_path / 'store/single.mcap').touch()
    (tmp_path / 'cell').mkdir()
    (tmp_path / 'cell/monday').symlink_to(tmp_path / 'store/night')
    (tmp_path / 'cell/tuesday.mcap').symlink_to(tmp_path / 'store/single.mcap')
    jobs = jobs_of([str(tmp_path / 'cell')], 'solve')
    assert [job.label for job in jobs] == ['monday', 'tuesday']
    fingerprint = jobs[0].fingerprint()
    (tmp_path / 'store/night/metadata.yaml').write_text('changed')
    assert jobs[0].fingerprint() != fingerprint


def test_lists_name_their_recordings_relative_to_them(tmp_path):
    (tmp_path / 'jobs.csv').write_text(
        'bag,label,settings,args\na,first,target.radius=0.02 kinematics=arm.yaml,\n'
        'b,,,sphere --calibration=cal --kinematics cal --set=a=sphere\na,second,,\n')
    for folder in ('sphere', 'cal'):
        (tmp_path / folder).mkdir()
    (tmp_path / 'arm.yaml').touch()
    jobs = jobs_of([str(tmp_path / 'jobs.csv')], 'solve', ('--config', 'c'))
    assert [job.label for job in jobs] == ['first', 'b', 'second']
    assert jobs[0].arguments == ('--config', 'c', '--set', 'target.radius=0.02', '--set',
                                 f'kinematics={tmp_path}/arm.yaml')
    assert jobs[0].bag == str(tmp_path / 'a')
    assert jobs[1].arguments == ('--config', 'c', 'sphere', '--calibration', f'{tmp_path}/cal',
                                 '--kinematics', f'{tmp_path}/cal', '--set', 'a=sphere')
    for text, sentence in (
            ('bag,lable\na,first\n', 'it has the columns bag, lable; expected'),
            ('bag,settings\na,verify.lengths=[0.1,0.2] name=x\n', 'row 1 has 3 values'),
            ("bag,args\na,it's\n", 'quotation mark that is not closed'),
            ('label,bag\na,b\nc\n', 'row 2 has 1 value,'),
            ('label,bag\na,b\nc,\n', 'a value in each row'), ('label\na\n', 'no column bag')):
        (tmp_path / 'jobs.csv').write_text(text)
        with pytest.raises(InputError, match=sentence):
            jobs_of([str(tmp_path / 'jobs.csv')], 'solve')
    (tmp_path / 'empty').mkdir()
    for name, sentence in ('empty', 'no recording'), ('missing.csv', 'is not there'):
        with pytest.raises(InputError, match=sentence):
            jobs_of([str(tmp_path / name)], 'solve')


def test_only_what_a_verb_takes_as_a_path_is_made_absolute(tmp_path):
    for name in ('sphere', '10', 'arm.yaml', 'cal.yaml', 'second.mcap'):
        (tmp_path / name).touch()
    assert arguments_of(
        'sphere second.mcap --folds 10 --calibration cal.yaml --kinematics=arm.yaml', None,
        ('target.type=sphere', 'verify.calibration=cal.yaml', 'output_dir='), tmp_path) == (
            'sphere', f'{tmp_path}/second.mcap', '--folds', '10', '--calibration',
            f'{tmp_path}/cal.yaml', '--kinematics', f'{tmp_path}/arm.yaml', '--set',
            'target.type=sphere', '--set', f'verify.calibration={tmp_path}/cal.yaml', '--set',
            'output_dir=')
    assert {*PATH_KEYS} < {parameter.key for parameter in parameters()}
    options = set()
    for verb in command().registered_commands:
        if verb.callback.__name__ in OUTPUTS:
            for name, parameter in inspect.signature(verb.callback).parameters.items():
                kind, info = get_args(parameter.annotation)
                if Path in (kind, *get_args(kind)) and isinstance(info, OptionInfo):
                    options.add(info.default if isinstance(info.default, str) else f'--{name}')
    assert options == {*PATH_OPTIONS, '--out'}


def test_recordings_and_foreign_files_are_never_replaced_by_results(tmp_path, monkeypatch):
    (tmp_path / 'nights').mkdir()
    (tmp_path / 'nights/plate.mcap').write_text('laser 1.0')
    (tmp_path / 'nights/plate').mkdir()
    (tmp_path / 'nights/plate/notes.txt').write_text('kept')
    jobs = jobs_of([str(tmp_path / 'nights')], 'solve')
    with pytest.raises(InputError, match='holds no result of batch'):
        list(job_rows(jobs, tmp_path / 'nights', pretended))
    assert (tmp_path / 'nights/plate/notes.txt').read_text() == 'kept'
    out = tmp_path / 'out'
    run(replace(jobs[0], label='a'), out, pretended)
    with pytest.raises(InputError, match='out/a/b would be inside the result '):
        list(job_rows([replace(jobs[0], label='a/b')], out, pretended))
    monkeypatch.chdir(tmp_path / 'nights')
    assert [job.label for job in jobs_of(['.'], 'solve')] == ['plate']
    (tmp_path / 'nights/metadata.yaml').touch()
    assert [job.label for job in jobs_of(['.'], 'solve')] == ['nights']
    for folder in ('cells/cell.1', 'cells/cell.2'):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / 'metadata.yaml').touch()
    jobs = jobs_of([str(tmp_path / 'cells')], 'solve')
    assert [job.label for job in jobs] == ['cell.1', 'cell.2']
    for labels in (('../keep',), ('.',), (str(tmp_path),), ('a', 'a/b'), ('a', 'a')):
        (tmp_path / 'jobs.csv').write_text('bag,label\n' + ''.join(f'x,{a}\n' for a in labels))
        with pytest.raises(InputError, match='no folder of its own'):
            jobs_of([str(tmp_path / 'jobs.csv')], 'solve')


@pytest.mark.thorough
def test_an_interrupt_says_how_far_it_came_and_a_second_run_goes_on(tmp_path):
    bag = ROOT / 'bags' / 'plate'
    (tmp_path / 'jobs.csv').write_text(
        'bag,label\n' + ''.join(f'{bag},{k:03}\n' for k in range(200)))
    command = [sys.executable, '-m', 'handeye_ros', 'batch', 'jobs.csv', '--out', 'out']
    with subprocess.Popen(command, cwd=tmp_path, start_new_session=True, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        while not list(tmp_path.glob('out/*/job.json')) and process.poll() is None:
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to all of them
        output = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130 and 'Traceback' not in ''.join(output), output
    done = len(list(tmp_path.glob('out/*/job.json')))
    assert f'{done} of 200 done; run again to continue' in output[1]
    assert 0 < done < 200 and len(list(tmp_path.glob('out/*/calibration.yaml'))) == done


@pytest.mark.once
@pytest.mark.parametrize(('words', 'sentence'), [
    (('--out', 'a.mcap'), 'cannot write'),
    (('--out', 'out', '--set', 'foo=1'), 'unknown key "foo"'),
    pytest.param(('--out', 'out', '--scheduler', 'tcp://127.0.0.1:9'),
                 'no Dask scheduler answers', marks=pytest.mark.thorough)])
def test_a_fault_of_all_jobs_is_said_at_once(words, sentence, tmp_path):
    (tmp_path / 'a.mcap').write_text('x')
    assert_refused(handeye('batch', 'a.mcap', *words, cwd=tmp_path), 2, sentence)


@pytest.mark.once
@pytest.mark.parametrize(('words', 'sentence'), [
    (('--args', '--foo 1'), 'No such option: --foo'),
    (('--verb', 'check'), "Missing option '--against'")])
def test_wrong_arguments_of_the_verb_are_wrong_usage(words, sentence, tmp_path):
    (tmp_path / 'a.mcap').write_text('x')
    run = handeye('batch', 'a.mcap', '--out', 'out', *words, cwd=tmp_path)
    assert run.returncode == 2 and sentence in run.stderr, run
    assert not (tmp_path / 'out').exists()


@pytest.mark.once
def test_only_an_unchanged_whole_result_is_not_computed_again(tmp_path):
    (tmp_path / 'a.mcap').write_text('laser 1.0')
    job, out = Job(str(tmp_path / 'a.mcap'), 'a', 'solve'), tmp_path / 'out'
    run(job, out, pretended)
    completed = handeye('batch', 'a.mcap', '--out', 'out', '--scheduler', 'tcp://127.0.0.1:9',
                        cwd=tmp_path)  # that does not exist, and is not asked
    assert completed.returncode == 0 and '0 computed' in completed.stdout, completed
    assert earlier_row(job, out)['x'] == 1.0
    assert earlier_row(replace(job, arguments=('--set=a=1',)), out) is None
    arm = replace(job, arguments=(f'--set=kinematics={tmp_path / "arm.yaml"}',))
    (tmp_path / 'arm.yaml').write_text('1')
    run(arm, out, lambda arguments: 0)
    assert earlier_row(arm, out)
    (tmp_path / 'arm.yaml').write_text('another')
    assert earlier_row(arm, out) is None
    (tmp_path / 'a.mcap').write_text('crash')
    assert run(job, out, pretended)['exit_code'] == 70 and earlier_row(job, out) is None
    (out / 'a/job.json').write_text('{"state": ')  # a client that was killed
    assert earlier_row(job, out) is None
