"""
Many small simulated recordings through `handeye batch`, beside a plain loop.

usage: python bench/batch.py [--jobs N] [--kills K] [--processes] [--loop M] [--folder DIR]

N recordings (12 stops of a plate, 62 profiles of 256 points), each of its own seed, are solved on
two local workers of Dask, or with --processes through `dask scheduler` and two `dask worker`.
With --kills (default 0: for the throughput) that many workers are killed on the way (signal 9),
then the client, which is started again. Printed: seconds beside those of a plain loop over M of
them (default 200), how many answers equal the loop's to the digit, how often each recording was
computed (workers count it when they end one), and the memory of client and workers on the way.
--folder keeps recordings and results: run again, what is there is not computed again.
"""
from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from handeye_ros.bags.bag_write import write
from handeye_ros.batch.jobs import Job, Row, run
from handeye_ros.batch.run import client_of, jobs_of, rows_of
from handeye_ros.cli.batch import run_verb
from handeye_ros.simulate import SCENARIOS, simulate
import numpy as np
import psutil

WORKERS = 2
KEEPING = {**os.environ, 'MALLOC_TRIM_THRESHOLD_': str(2**27)}  # docs/batch.md
SAME = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw', 'residual_rms', 'exit_code', 'cause')
CELL = 100  # recordings of each
PLATE = SCENARIOS['small_plate']
SMALL = replace(PLATE, stations=(6, 6), robot=replace(PLATE.robot, rate=25.0, move=0.8),
                sensor=replace(PLATE.sensor, columns=256, rate=5.0, thinning=20))


def make(folder: Path, seed: int) -> None:
    """Write the recording of a seed, unless it is there."""
    path = folder / f'{seed:05}'
    if not path.exists():
        made = simulate(SMALL, np.random.default_rng(seed))
        write(path, made.profiles, made.poses)


def jobs_in(folder: Path) -> list[Job]:
    """Return the jobs of the list in a folder."""
    return jobs_of([str(folder / 'jobs.csv')], Job('', '', 'solve'))


def counted(ended: Path, words: list[str]) -> int:
    """Run a verb, and note at its end that it was computed."""
    code = run_verb(words)
    with ended.open('a') as stream:  # one line is written at once
        stream.write(f'{words[1]}\n')
    return code


def run_client(folder: Path, address: str) -> None:
    """Run the batch and print its rows; the process that is killed."""
    with client_of(address, workers=WORKERS) as client:
        client.wait_for_workers(WORKERS)
        warm = [replace(job, label=f'warm/{job.label}') for job in jobs_in(folder)[:8]]
        list(rows_of(client, warm, folder / f'warm{os.getpid()}', run_verb))
        print('{}', flush=True)
        for row in rows_of(client, jobs_in(folder), folder / 'out',
                           partial(counted, folder / 'ended.txt')):
            print(json.dumps(row), flush=True)


def cpu(pid: int) -> float:
    """Return the CPU seconds of a process so far."""
    try:
        return sum(psutil.Process(pid).cpu_times()[:2])
    except psutil.Error:
        return 0.0


def memory(pid: int, workers: set[int]) -> tuple[float, float]:
    """Return the memory of the client, and of the largest worker (MB)."""
    sizes = {}
    for one in {pid, *workers}:
        try:
            sizes[one] = psutil.Process(one).memory_info().rss / 1e6
        except psutil.Error:
            continue
    return sizes.pop(pid, 0.0), max(sizes.values(), default=0.0)


def watch(folder: Path, address: str, count: int, kills: int, end: bool
          ) -> tuple[dict[str, Row], float, list[tuple[float, float]]]:
    """
    Run a client, kill workers on the way, and the client itself at three quarters if so wanted.

    Return the rows, the seconds between the first and the last, and the memory on the way.
    """
    client = subprocess.Popen([sys.executable, __file__, '--client', address, '--folder',
                               str(folder)], stdout=subprocess.PIPE, text=True)
    assert client.stdout is not None
    rows: dict[str, Row] = {}
    sizes, start, workers, used = [], 0.0, set[int](), [0.0, 0.0]
    for line in client.stdout:
        row = json.loads(line)
        if not row:
            start, used[0] = time.perf_counter(), cpu(client.pid)
            continue
        rows[row['label']] = row
        workers = {*[*workers, row.get('worker', 0)][-8:]}
        if len(rows) % max(count // 5, 1) == 0:
            sizes.append(memory(client.pid, workers))
        if len(rows) == count:
            used[1] = cpu(client.pid)
        if kills and row['computed'] and 'worker' in row and (
                len(rows) % max(count // 8, 1) == count // 16):
            kills -= 1
            os.kill(row['worker'], signal.SIGKILL)
        if end and len(rows) > 0.75 * count:
            client.kill()
            end = False
    seconds = time.perf_counter() - start
    client.wait()
    print(f'CPU of the client: {1e3 * (used[1] - used[0]) / count:.1f} ms for each job')
    return rows, seconds, sizes


@contextmanager
def scheduler(processes: bool, folder: Path) -> Iterator[str]:
    """Give the address of a scheduler with two workers as processes of their own, or `local`."""
    if not processes:
        yield 'local'
        return
    dask = [sys.executable, '-m', 'dask']
    file = folder / 'scheduler.json'
    file.unlink(missing_ok=True)
    with (folder / 'dask.log').open('w') as log:
        started = [subprocess.Popen([*dask, *words], stdout=log, stderr=log, cwd=folder,
                                    env=KEEPING) for words in (
            ['scheduler', '--port', '0', '--dashboard-address', ':0', '--scheduler-file', file],
            *[['worker', '--scheduler-file', file, '--nthreads', '1']] * WORKERS)]
        try:
            while not file.exists():
                time.sleep(0.1)
            yield json.loads(file.read_text())['address']
        finally:
            for process in started:
                process.terminate()
            for process in started:
                process.wait()


def report(folder: Path, jobs: list[Job], rows: dict[str, Row], seconds: float, loop: int
           ) -> None:
    """Print what became of the jobs beside a plain loop over some of them."""
    every = jobs[::max(len(jobs) // loop, 1)]
    run(replace(every[0], label='first'), folder / 'plain', run_verb)
    start = time.perf_counter()
    plain = [run(job, folder / f'plain{os.getpid()}', run_verb) for job in every]
    each = (time.perf_counter() - start) / len(plain)
    same = sum(all(rows[r['label']].get(n) == r.get(n) for n in SAME) for r in plain)
    times = Counter(Counter((folder / 'ended.txt').read_text().split()).values())
    codes = Counter(row['exit_code'] for row in rows.values())
    new = sum(row['computed'] for row in rows.values())  # the others a client had before
    print(f'{len(rows)} of {len(jobs)} rows, {new} computed in {seconds:.1f} s, '
          f'{1e3 * seconds / new:.1f} ms each; a plain loop {1e3 * each:.1f} ms each: '
          f'{each * new / seconds:.2f} times as fast')
    print(f'exit codes {dict(codes)}; equal to the loop: {same} of {len(plain)}; recordings by '
          f'how often they were computed: {dict(times)}')


def measure(folder: Path, arguments: Any) -> None:
    """Make recordings, run the batch, and print what came of it."""
    count = arguments.jobs
    (folder / 'bags').mkdir(exist_ok=True)
    (folder / 'jobs.csv').write_text('bag,label\n' + ''.join(
        f'bags/{k:05},{k // CELL:03}/{k % CELL:03}\n' for k in range(count)))
    with client_of('local', workers=WORKERS) as client:
        client.gather(client.map(partial(make, folder / 'bags'), range(count), batch_size=50))
    with scheduler(arguments.processes, folder) as address:
        rows, seconds, sizes = watch(folder, address, count, arguments.kills,
                                     end=arguments.kills > 0)
        if arguments.kills:
            print(f'client killed after {len(rows)} rows')
            rows, seconds, more = watch(folder, address, count, 0, end=False)
            print(f'started again: {sum(row["computed"] for row in rows.values())} computed')
            sizes += more
    report(folder, jobs_in(folder), rows, seconds, arguments.loop)
    print('memory of client and largest worker on the way (MB):',
          ', '.join(f'{a:.0f} and {b:.0f}' for a, b in sizes))


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--jobs', type=int, default=500)
    parser.add_argument('--kills', type=int, default=0)
    parser.add_argument('--processes', action='store_true')
    parser.add_argument('--loop', type=int, default=200)
    parser.add_argument('--folder', type=Path)
    parser.add_argument('--client', help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.client:
        run_client(arguments.folder, arguments.client)
    elif arguments.folder:
        arguments.folder.mkdir(parents=True, exist_ok=True)
        measure(arguments.folder.absolute(), arguments)
    else:
        with tempfile.TemporaryDirectory() as name:
            measure(Path(name), arguments)


if __name__ == '__main__':
    main()
