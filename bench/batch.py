"""
Many small recordings through `handeye batch`, beside a plain loop, with workers that are killed.

usage: .venv/bin/python bench/batch.py [JOBS [KILLS]]

JOBS (default 500) tables of points, each its own, are solved on local workers of Dask: seconds,
the largest memory of client and workers, whether each result equals that of a plain loop over a
tenth of them to the digit. KILLS (default 3) workers are killed on the way; then all is run again.
"""
from __future__ import annotations

from contextlib import redirect_stderr, redirect_stdout
import io
import os
from pathlib import Path
import signal
import sys
import tempfile
import time

from handeye_ros.batch.jobs import Job, jobs_of, run
from handeye_ros.batch.run import client_of, rows_of
from handeye_ros.cli.batch import run_verb
import numpy as np
import psutil

SETTINGS = ('target.type=points', 'calibration_type=eye_on_base')
SAME = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw', 'residual_rms', 'exit_code')


def tables(folder: Path, count: int) -> Path:
    """Write that many tables of points with noise of their own, and a list of them."""
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        run_verb(['simulate', 'points', str(folder / 'made')])
    head, *lines = (folder / 'made' / 'points.csv').read_text().splitlines()
    values = np.array([line.split(',') for line in lines], dtype=float)
    rng = np.random.default_rng(0)
    names = ['bag,label']
    for k in range(count):
        noisy = values + 0.01 * rng.normal(size=values.shape)  # mm
        (folder / f'{k:05}.csv').write_text('\n'.join(
            [head, *(','.join(f'{v:.6f}' for v in row) for row in noisy)]) + '\n')
        names.append(f'{k:05}.csv,{k // 100:03}/{k:05}')
    (folder / 'jobs.csv').write_text('\n'.join(names) + '\n')
    return folder / 'jobs.csv'


def memory() -> tuple[float, float]:
    """Return the memory of this process, and the largest of those it started (MB)."""
    own = psutil.Process()
    sizes = [0.0]
    for child in own.children(recursive=True):
        try:
            sizes.append(child.memory_info().rss / 1e6)
        except psutil.Error:
            continue
    return own.memory_info().rss / 1e6, max(sizes)


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 500
    kills = int(sys.argv[2]) if len(sys.argv) > 2 else 3
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        jobs = jobs_of([tables(folder, count)], Job('', '', 'solve', settings=SETTINGS))
        with client_of('local') as client:
            list(rows_of(client, jobs[:20], folder / 'warm', run_verb))
            start, rows, at = time.perf_counter(), {}, []
            for row in rows_of(client, jobs, folder / 'out', run_verb):
                rows[row['label']] = row
                if kills and len(rows) % max(count // (kills + 1), 1) == 0 and 'worker' in row:
                    kills -= 1
                    os.kill(row['worker'], signal.SIGKILL)
                if len(rows) % max(count // 5, 1) == 0:
                    at.append(memory())
            seconds = time.perf_counter() - start
            again = list(rows_of(client, jobs, folder / 'out', run_verb))
        start = time.perf_counter()
        plain = [run(job, folder / 'plain', run_verb) for job in jobs[:max(count // 10, 1)]]
        each = (time.perf_counter() - start) / len(plain)
        same = sum(all(rows[r['label']][n] == r[n] for n in SAME) for r in plain)
        print(f'{count} jobs: {seconds:.1f} s, {1e3 * seconds / count:.1f} ms each; a plain loop '
              f'{1e3 * each:.1f} ms each: {each * count / seconds:.2f} times as fast')
        print(f'answers: {sum(r["exit_code"] == 0 for r in rows.values())}; equal to the loop: '
              f'{same} of {len(plain)}; computed in the second run: '
              f'{sum(r["computed"] for r in again)}')
        print('memory of client and largest worker on the way (MB):',
              ', '.join(f'{a:.0f} and {b:.0f}' for a, b in at))


if __name__ == '__main__':
    main()
