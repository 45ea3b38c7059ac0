"""Many recordings through one verb: rows, what is computed again, and what a lost worker costs."""
from __future__ import annotations

import csv
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
import json
import multiprocessing
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading
import time

from command import assert_refused, handeye, PATIENCE, ROOT
from handeye_ros.batch.errors import JobListError, NoJobsError, RemoteError
from handeye_ros.batch.jobs import CRASHED, Job, run
from handeye_ros.batch.report import cell_of, cells_of, write_report
from handeye_ros.batch.run import client_of, jobs_of, rows_of, write_rows
from handeye_ros.cli.batch import run_verb
import pytest

pytest.importorskip('distributed', reason='needs distributed')
parquet = pytest.importorskip('pyarrow.parquet', reason='needs pyarrow')


def pretended(words: list[str]) -> int:
    """Do as a verb does, by what the recording holds; counts how often it ran."""
    bag, out = Path(words[1]), Path(words[words.index('--out') + 1])
    text = bag.read_text()
    with bag.with_suffix('.runs').open('a') as stream:
        stream.write('x')
    if text == 'kill':
        os._exit(9)
    if text == 'memory':
        held = []
        while True:  # a step each 10 ms: what ends it is the limit of the worker
            held.append(bytearray(8_000_000))
            time.sleep(0.01)
    if text == 'crash':
        raise ZeroDivisionError('a fault')
    if text == 'refuse':
        import sys
        print('error: no target was seen', file=sys.stderr)
        return 3
    (out / 'calibration.yaml').write_text(f'method: plate\nquality: {{residual_rms: {text}}}\n')
    return 0


def counting(words: list[str]) -> int:
    """Do as a verb does that wants a bag of two files."""
    return 0 if len(os.listdir(words[1])) == 2 else 2


class Quiet(SimpleHTTPRequestHandler):
    """Files by HTTP, without a log."""

    def log_message(self, *arguments):
        pass


@pytest.fixture(scope='module')
def client():
    with client_of('local', workers=2, memory='500MB') as client:
        yield client


def recordings(folder: Path) -> list[Path]:
    """Return files that stand for recordings: ten good ones, and one of each that is not."""
    texts = {f'good{k}': f'{k}.0e-05' for k in range(10)}
    texts |= {'killing': 'kill', 'memory': 'memory', 'crashing': 'crash', 'refused': 'refuse'}
    for name, text in texts.items():
        (folder / f'{name}.mcap').write_text(text)
    return sorted(folder.glob('*.mcap'))


def test_each_job_costs_itself_and_is_computed_once(client, tmp_path):
    files = recordings(tmp_path)
    jobs = jobs_of([str(tmp_path)], Job('', '', 'solve'))
    assert [job.label for job in jobs] == [file.stem for file in files]
    rows = {row['label']: row for row in rows_of(client, jobs, tmp_path / 'out', pretended)}
    assert len(rows) == len(files)
    assert {name: row['exit_code'] for name, row in rows.items() if row['exit_code']} == {
        'killing': CRASHED, 'memory': CRASHED, 'crashing': CRASHED, 'refused': 3}
    assert rows['refused']['cause'] == 'no target was seen'
    assert rows['crashing']['cause'] == 'ZeroDivisionError: a fault'
    assert all('worker' in rows[name]['cause'].lower() for name in ('killing', 'memory'))
    assert rows['good7']['residual_rms'] == 7e-5
    (tmp_path / 'good3.mcap').write_text('1.0')
    again = {row['label']: row for row in rows_of(
        client, [job for job in jobs if job.label not in ('killing', 'memory')],
        tmp_path / 'out', pretended)}
    assert [name for name, row in again.items() if row['computed']] == ['good3']
    assert again['good3']['residual_rms'] == 1.0
    assert (tmp_path / 'good7.runs').read_text() == 'x'
    assert not list((tmp_path / 'out').glob('.good*')), 'half results are left'
    write_rows([*rows.values()], tmp_path / 'out')
    write_report([*rows.values()], [], tmp_path / 'out' / 'report.html')
    with (tmp_path / 'out/results.csv').open() as stream:
        table = list(csv.DictReader(stream))
    assert [row['label'] for row in table] == sorted(rows)
    assert parquet.read_table(tmp_path / 'out/results.parquet').num_rows == len(files)
    page = (tmp_path / 'out/report.html').read_text()
    assert 'no target was seen' in page and 'good7/output.txt' in page


def test_a_result_is_there_whole_or_not_at_all(tmp_path):
    (tmp_path / 'a.mcap').write_text('1.0')
    job = Job(str(tmp_path / 'a.mcap'), 'cell/a', 'solve')
    assert run(job, tmp_path / 'out', pretended)['computed']
    held = json.loads((tmp_path / 'out/cell/a/job.json').read_text())
    assert held['key'] == job.key() != Job(job.bag, 'cell/a', 'solve', settings=('a=1',)).key()
    (tmp_path / 'out/cell/a/job.json').write_text('{"key": ')  # a client that was killed
    assert run(job, tmp_path / 'out', pretended)['computed']


def test_two_workers_at_one_job_compute_it_once(tmp_path):
    (tmp_path / 'a.mcap').write_text('1.0')
    job = Job(str(tmp_path / 'a.mcap'), 'a', 'solve')
    fork = multiprocessing.get_context('fork')
    started, ends = [fork.Event(), fork.Event()], fork.Event()

    def held(number: int, words: list[str]) -> int:
        started[number].set()
        ends.wait()
        return pretended(words)

    workers = [fork.Process(target=run, args=(job, tmp_path / 'out', partial(held, k)))
               for k in range(2)]
    workers[0].start()
    started[0].wait()
    workers[1].start()
    assert not started[1].wait(0.5), 'the second computes what the first has not ended'
    ends.set()
    for worker in workers:
        worker.join()
    assert not run(job, tmp_path / 'out', pretended)['computed']
    assert (tmp_path / 'a.runs').read_text() == 'x'


def test_recordings_are_taken_by_url(tmp_path):
    from fsspec.implementations.memory import MemoryFileSystem
    system = MemoryFileSystem()
    system.pipe({'/nights/cell/a.mcap': b'1.0', '/nights/cell/b/metadata.yaml': b'',
                 '/nights/cell/b/b.mcap': b'2.0'})
    jobs = jobs_of(['memory://nights'], Job('', '', 'solve'))
    assert [job.label for job in jobs] == ['cell/a', 'cell/b']
    (tmp_path / 'c.mcap').touch()
    assert [job.label for job in jobs_of(['memory://nights/cell', str(tmp_path / 'c.mcap')],
                                         jobs[0])] == ['cell/a', 'cell/b', 'c']
    row = run(jobs[0], tmp_path / 'out', pretended)
    assert row['residual_rms'] == 1.0 and row['bag'] == 'memory://nights/cell/a.mcap'
    assert not run(jobs[0], tmp_path / 'out', pretended)['computed']
    system.pipe('/nights/cell/a.mcap', b'3.0')
    assert run(jobs[0], tmp_path / 'out', pretended)['residual_rms'] == 3.0
    for _ in range(2):  # what is unreadable at its URL is tried again
        assert run(jobs[1], tmp_path / 'out', lambda words: 2)['computed']
    missing = run(Job('memory://nights/none.mcap', 'none', 'solve'), tmp_path / 'out', pretended)
    assert missing['exit_code'] == 2 and 'memory://nights/none.mcap' in missing['cause']


def test_a_web_server_gives_folders_and_is_missed_in_a_sentence(tmp_path):
    (tmp_path / 'nights/b').mkdir(parents=True)
    (tmp_path / 'nights/b/metadata.yaml').write_text('a')
    (tmp_path / 'nights/b/b.mcap').write_text('2.0')
    with ThreadingHTTPServer(('127.0.0.1', 0), partial(
            Quiet, directory=str(tmp_path))) as server:
        threading.Thread(target=server.serve_forever).start()
        job, = jobs_of([f'http://127.0.0.1:{server.server_port}/nights'], Job('', '', 'solve'))

        def computed() -> bool:
            return run(job, tmp_path / 'out', counting)['computed']

        assert job.label == 'b' and computed() and not computed()
        (tmp_path / 'nights/b/metadata.yaml').write_text('changed')
        assert computed()
        server.shutdown()
    row = run(job, tmp_path / 'out', counting)
    assert row['exit_code'] == 2 and row['cause'].startswith(f'{job.bag} cannot be read (')
    with pytest.raises(RemoteError, match='cannot be read'):
        jobs_of([job.bag], job)


def test_each_cell_is_shown_through_time(tmp_path):
    rows = [{'label': f'{cell}/night_{k}', 'verb': 'check', 'exit_code': int(k == 5), 'stamp': -k,
             'verdict': 'sensor' if k == 5 else 'unchanged', 'rms': 2e-5, 'points_off': 1e-4 * k,
             'points_off_std': 1e-5, 'seconds': 1.0} for k in range(6) for cell in 'ab']
    rows.append({'label': 'c/night_0', 'verb': 'check', 'exit_code': 3, 'cause': 'off by 3.1 mm'})
    cells = cells_of(rows)
    assert list(cells) == ['a', 'b'] and cells['a'][0]['label'] == 'a/night_5'
    (tmp_path / 'a').mkdir()
    cell = cell_of('a', cells['a'], tmp_path)
    assert cell.sentence == 'sensor; unchanged since a/night_4'
    assert (tmp_path / cell.picture).stat().st_size > 1000
    write_report(rows, [cell], tmp_path / 'report.html')
    page = (tmp_path / 'report.html').read_text()
    assert 'src="a/trend.png"' in page and 'off by # mm' in page


def test_lists_name_their_recordings_relative_to_them(tmp_path):
    (tmp_path / 'jobs.csv').write_text(
        'bag,label,settings\na,first,target.radius=0.02 name=x\nb,,\na,first,\n')
    jobs = jobs_of([str(tmp_path / 'jobs.csv')], Job('', '', 'solve', config='c.yaml'))
    assert [job.label for job in jobs] == ['first', 'b', 'first-2']
    assert jobs[0].settings == ('target.radius=0.02', 'name=x')
    assert jobs[0].bag == str(tmp_path / 'a') and jobs[1].config == 'c.yaml'
    (tmp_path / 'jobs.yaml').write_text('- {bag: a, args: sphere --length 0.2}\n')
    assert jobs_of([str(tmp_path / 'jobs.yaml')], Job('', '', 'verify'))[0].args == (
        'sphere', '--length', '0.2')
    (tmp_path / 'jobs.yaml').write_text('bag: a\n')
    with pytest.raises(JobListError):
        jobs_of([str(tmp_path / 'jobs.yaml')], Job('', '', 'solve'))
    (tmp_path / 'empty').mkdir()
    for source in ('empty', 'missing.csv'):
        with pytest.raises(NoJobsError):
            jobs_of([str(tmp_path / source)], Job('', '', 'solve'))
    (tmp_path / 'jobs.csv').write_text('bag,lable\na,first\n')
    with pytest.raises(JobListError, match='it has bag, lable; expected'):
        jobs_of([str(tmp_path / 'jobs.csv')], Job('', '', 'solve'))


@pytest.mark.thorough
def test_an_interrupt_ends_all_quietly(tmp_path):
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
    assert 0 < done < 200 and len(list(tmp_path.glob('out/*/calibration.yaml'))) == done


@pytest.mark.once
def test_a_scheduler_that_is_not_there_is_said(tmp_path):
    (tmp_path / 'a.mcap').write_text('x')
    run_ = handeye('batch', 'a.mcap', '--out', 'out', '--scheduler', 'tcp://127.0.0.1:9',
                   cwd=tmp_path)
    assert_refused(run_, 2, 'no Dask scheduler answers')


@pytest.mark.parametrize(('words', 'sentence'), [
    (('--out', 'a.mcap'), 'cannot write'), (('--out', 'out', '--memory', 'lots'), '"lots" is no'),
    (('--out', 'out', '--set', 'foo=1'), 'unknown key "foo"')])
def test_a_fault_of_all_jobs_is_said_at_once(words, sentence, tmp_path, capsys, monkeypatch):
    (tmp_path / 'a.mcap').write_text('x')
    monkeypatch.chdir(tmp_path)
    assert run_verb(['batch', 'a.mcap', *words]) == 2
    assert sentence in capsys.readouterr().err
