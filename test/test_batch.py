# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Many recordings through one verb: rows, what is computed again, and what a lost worker costs."""
from __future__ import annotations

import csv
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading
import time

from command import assert_refused, handeye, PATIENCE, ROOT
from handeye_ros.batch import CRASHED, Job, jobs_of, rows_of, run, unchanged, write_table
from handeye_ros.errors import DataError, InputError
import pytest

pytest.importorskip('distributed', reason='needs distributed')


def pretended(words: list[str]) -> int:
    """Do as a verb does, by what the recording holds."""
    bag, out = Path(words[1]), Path(words[words.index('--out') + 1])
    text = bag.read_text()
    if text == 'kill':
        os._exit(9)
    if text == 'crash':
        raise ZeroDivisionError('a fault')
    if text == 'refuse':
        print('error: no target was seen within 3.1 mm', file=sys.stderr)
        return 3
    (out / 'calibration.yaml').write_text(f'method: plate\nquality: {{residual_rms: {text}}}\n')
    return 0


class Quiet(SimpleHTTPRequestHandler):
    """Files by HTTP, without a log."""

    def log_message(self, *arguments):
        pass


def test_each_job_costs_itself_and_is_computed_once(tmp_path):
    texts = {f'good{k}': f'{k}.0e-05' for k in range(6)}
    texts |= {'killing': 'kill', 'crashing': 'crash', 'refused': 'refuse'}
    for name, text in texts.items():
        (tmp_path / f'{name}.mcap').write_text(text)
    out, jobs = tmp_path / 'out', jobs_of([str(tmp_path)], Job('', '', 'solve'))
    assert [job.label for job in jobs] == sorted(texts)
    rows = {row['label']: row for row in rows_of(jobs, out, pretended)}
    assert {name: row['exit_code'] for name, row in rows.items() if row['exit_code']} == {
        'killing': CRASHED, 'crashing': CRASHED, 'refused': 3}
    assert rows['crashing']['cause'] == 'ZeroDivisionError: a fault'
    assert 'worker' in rows['killing']['cause'].lower()
    assert rows['good5']['residual_rms'] == 5e-5
    (tmp_path / 'good3.mcap').write_text('1.0')
    again = {job.label for job in jobs if unchanged(job, out) is None}
    assert again == {'good3', 'killing'}
    write_table([*rows.values()], out)
    with (out / 'results.csv').open() as stream:
        assert [row['label'] for row in csv.DictReader(stream)] == sorted(rows)
    page = (out / 'report.html').read_text()
    assert 'no target was seen within 3.1 mm' in page and 'good5/output.txt' in page
    assert 'residual RMS [mm]' in page and '0.05' in page


def test_a_result_is_there_whole_or_not_at_all(tmp_path):
    (tmp_path / 'a.mcap').write_text('1.0')
    job, out = Job(str(tmp_path / 'a.mcap'), 'cell/a', 'solve'), tmp_path / 'out'
    run(job, out, pretended)
    assert unchanged(job, out)['residual_rms'] == 1.0
    assert unchanged(Job(job.bag, 'cell/a', 'solve', settings=('a=1',)), out) is None
    (out / 'cell/a/job.json').write_text('{"state": ')  # a client that was killed
    assert unchanged(job, out) is None


def test_recordings_are_taken_by_url(tmp_path):
    from fsspec.implementations.memory import MemoryFileSystem
    system, out = MemoryFileSystem(), tmp_path / 'out'
    system.pipe({'/nights/cell/a.mcap': b'1.0', '/nights/cell/b/metadata.yaml': b'',
                 '/nights/cell/b/b.mcap': b'2.0'})
    jobs = jobs_of(['memory://nights'], Job('', '', 'solve'))
    assert [job.label for job in jobs] == ['cell/a', 'cell/b']
    (tmp_path / 'c.mcap').touch()
    assert [job.label for job in jobs_of(['memory://nights/cell', str(tmp_path / 'c.mcap')],
                                         jobs[0])] == ['cell/a', 'cell/b', 'c']
    row = run(jobs[0], out, pretended)
    assert row['residual_rms'] == 1.0 and row['bag'] == 'memory://nights/cell/a.mcap'
    assert unchanged(jobs[0], out)
    system.pipe('/nights/cell/a.mcap', b'3.0')
    assert unchanged(jobs[0], out) is None
    both = run(jobs[1], out, lambda words: 0 if len(os.listdir(words[1])) == 2 else 2)
    assert both['exit_code'] == 0
    missing = Job('memory://nights/none.mcap', 'none', 'solve')
    assert run(missing, out, pretended)['exit_code'] == 2 and unchanged(missing, out) is None


def test_a_web_server_gives_folders_and_is_missed_in_a_sentence(tmp_path):
    (tmp_path / 'nights/b').mkdir(parents=True)
    (tmp_path / 'nights/b/metadata.yaml').write_text('a')
    (tmp_path / 'nights/b/b.mcap').write_text('2.0')
    with ThreadingHTTPServer(('127.0.0.1', 0), partial(
            Quiet, directory=str(tmp_path))) as server:
        threading.Thread(target=server.serve_forever).start()
        job, = jobs_of([f'http://127.0.0.1:{server.server_port}/nights'], Job('', '', 'solve'))
        row = run(job, tmp_path / 'out',
                  lambda words: 0 if len(os.listdir(words[1])) == 2 else 2)
        assert (job.label, row['exit_code']) == ('b', 0)
        server.shutdown()
    row = run(job, tmp_path / 'out', pretended)
    assert row['exit_code'] == 2 and row['cause'].startswith(f'{job.bag} cannot be read (')
    with pytest.raises(InputError, match='cannot be read'):
        jobs_of([job.bag], job)


def test_the_page_says_since_when_a_cell_has_changed(tmp_path):
    rows = [{'label': f'{cell}/night_{k}', 'verb': 'check', 'exit_code': int(k == 5), 'stamp': -k,
             'verdict': 'sensor' if k == 5 else 'unchanged', 'rms': 2e-5, 'seconds': 1.0}
            for k in range(6) for cell in 'ab']
    write_table(rows, tmp_path)
    assert 'sensor; unchanged since a/night_4' in (tmp_path / 'report.html').read_text()


def test_lists_name_their_recordings_relative_to_them(tmp_path):
    (tmp_path / 'jobs.csv').write_text(
        'bag,label,settings\na,first,target.radius=0.02 name=x\nb,,\na,first,\n')
    jobs = jobs_of([str(tmp_path / 'jobs.csv')], Job('', '', 'solve', config='c.yaml'))
    assert [job.label for job in jobs] == ['first', 'b', 'first-2']
    assert jobs[0].settings == ('target.radius=0.02', 'name=x')
    assert jobs[0].bag == str(tmp_path / 'a') and jobs[1].config == 'c.yaml'
    (tmp_path / 'jobs.yaml').write_text('- {bag: a, args: sphere --stations s.csv}\n')
    assert jobs_of([str(tmp_path / 'jobs.yaml')], Job('', '', 'verify'))[0].args == (
        'sphere', '--stations', 's.csv')
    (tmp_path / 'jobs.yaml').write_text('bag: a\n')
    with pytest.raises(InputError, match='expected a CSV or YAML list'):
        jobs_of([str(tmp_path / 'jobs.yaml')], Job('', '', 'solve'))
    (tmp_path / 'empty').mkdir()
    for source in ('empty', 'missing.csv'):
        with pytest.raises(DataError, match='no recording'):
            jobs_of([str(tmp_path / source)], Job('', '', 'solve'))
    (tmp_path / 'jobs.csv').write_text('bag,lable\na,first\n')
    with pytest.raises(InputError, match='it has bag, lable; expected'):
        jobs_of([str(tmp_path / 'jobs.csv')], Job('', '', 'solve'))


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
        said = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130 and 'Traceback' not in ''.join(said), said
    done = len(list(tmp_path.glob('out/*/job.json')))
    assert f'{done} of 200 done; run again to continue' in said[1]
    assert 0 < done < 200 and len(list(tmp_path.glob('out/*/calibration.yaml'))) == done


@pytest.mark.once
@pytest.mark.parametrize(('words', 'sentence'), [
    (('--out', 'a.mcap'), 'cannot write'),
    (('--out', 'out', '--set', 'foo=1'), 'unknown key "foo"'),
    (('--out', 'out', '--scheduler', 'tcp://127.0.0.1:9'), 'no Dask scheduler answers')])
def test_a_fault_of_all_jobs_is_said_at_once(words, sentence, tmp_path):
    (tmp_path / 'a.mcap').write_text('x')
    assert_refused(handeye('batch', 'a.mcap', *words, cwd=tmp_path), 2, sentence)


@pytest.mark.once
def test_an_unchanged_second_run_computes_nothing(tmp_path):
    (tmp_path / 'a.mcap').write_text('1.0')
    run(Job(str(tmp_path / 'a.mcap'), 'a', 'solve'), tmp_path / 'out', pretended)
    said = handeye('batch', 'a.mcap', '--out', 'out', '--scheduler', 'tcp://127.0.0.1:9',
                   cwd=tmp_path)  # that does not exist, and is not asked
    assert said.returncode == 0 and '0 computed' in said.stdout, said
