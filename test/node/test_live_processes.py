# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A running session without ROS: its thread and processes, which take their time or end."""
from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
import os
from pathlib import Path
import select
import signal
import subprocess
import sys
import threading

from cells import set_to
from command import PATIENCE
from handeye_ros import pipeline
from handeye_ros.config import Config
from handeye_ros.errors import DataError
from handeye_ros.node import solver
from handeye_ros.node.pool import Pool, PoolEndedError
from handeye_ros.node.state import sample_count, state_of
from handeye_ros.sampling.features import result_of
from live_sessions import (
    changed,
    computed,
    fed,
    feed,
    feed_one,
    Inline,
    new,
    PARTS,
    TO_VERIFY,
    update,
)
import pytest


class Gate(Inline):
    """Evaluates stops at once, and all else too while it is open."""

    def __init__(self) -> None:
        super().__init__()
        self.open, self.threads = threading.Event(), ThreadPoolExecutor(2)

    def submit(self, function, *args) -> Future:
        if self.open.is_set() or function is result_of:
            return super().submit(function, *args)
        return self.threads.submit(lambda: self.open.wait(PATIENCE) and function(*args))


def test_nobody_waits_for_a_solve_or_a_verdict() -> None:
    gate = Gate()
    live = new(TO_VERIFY, gate)
    gate.open.set()
    feed(live, PARTS[0].messages)
    live.start()
    computed(live)
    gate.open.clear()
    changed(live, noise__sensor=5e-5)  # else it is not computed again
    answer = live.worker.call(live.solver.compute_calibration)
    assert live.working == 'the calibration is computed'
    assert ' taken again, ' in live.worker.call(live.take_sample)
    assert live.worker.call(live.remove_last_sample).startswith('removed sample ')
    saved = live.worker.call(live.solver.save_calibration)
    assert saved.endswith('again: save it again after that')
    gate.open.set()
    assert answer.result(PATIENCE).startswith('laser in flange')
    live.worker.call(live.verification.verify_start)
    for item in PARTS[1].messages:
        feed_one(live, item)
    gate.open.clear()
    result = live.worker.call(live.verification.verify_result)
    assert 'verified' in live.working
    # the verification goes on until it has an answer, and stops count for it
    assert live.worker.call(live.take_sample).startswith('sphere: ')
    # another one, which the result does not end
    live.worker.call(live.verification.verify_start)
    gate.open.set()
    assert result.result(PATIENCE).startswith('sphere: PASS, ')
    assert live.verification.text.startswith('sphere: 0 usable stops')
    gate.open.clear()
    answer = live.worker.call(live.solver.compute_calibration)
    live.worker.call(live.clear_samples)
    gate.open.set()
    with pytest.raises(DataError, match='cleared while the calibration was computed'):
        answer.result(PATIENCE)


def test_a_stop_that_takes_long_is_told_meanwhile() -> None:
    working = []

    class Telling(Inline):
        def submit(self, function, *args) -> Future:
            working.append(state_of(live)['session']['working'])
            return super().submit(function, *args)

    live = new(pool=Telling())
    feed(live, PARTS[0].messages)
    assert 'a stop is evaluated' in working and state_of(live)['session']['working'] == ''


def test_a_stop_is_not_lost_where_its_process_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    live, ended = new(), Future()
    ended.set_exception(PoolEndedError())
    submit = live.pool.submit
    monkeypatch.setattr(live.pool, 'submit', lambda function, *args: (
        ended if function is result_of else submit(function, *args)))
    feed(live, PARTS[0].messages)
    state = state_of(live)
    assert len(state['samples']) >= 7 and sample_count(state) == 0
    assert 'ended before it had an answer' in state['samples'][0]['text']
    monkeypatch.undo()
    computed(live)
    assert sample_count(state_of(live)) >= 7


def test_a_review_and_an_answer_whose_process_ended_are_made_again(
        monkeypatch: pytest.MonkeyPatch) -> None:
    live, ended = fed(), Future()
    text, last = computed(live), state_of(live)['guidance']['sample']
    live.remove_last_sample()
    ended.set_exception(PoolEndedError())
    monkeypatch.setattr(live.pool, 'submit', lambda *args: ended)
    update(live)
    assert 'ended before it had an answer' in state_of(live)['session']['trouble'], 'of the review'
    with pytest.raises(PoolEndedError):
        computed(live)
    monkeypatch.undo()
    update(live)
    assert state_of(live)['guidance']['sample'] == last - 1
    assert computed(live) not in ('', text)
    assert not state_of(live)['session']['trouble']


def test_a_late_review_does_not_replace_a_newer_one(monkeypatch: pytest.MonkeyPatch) -> None:
    live = fed()
    late_review, submit = Future(), live.pool.submit
    monkeypatch.setattr(live.pool, 'submit', lambda *args: late_review)
    live.remove_last_sample()
    update(live)
    monkeypatch.setattr(live.pool, 'submit', submit)
    old_review = live.solver.review
    live.remove_last_sample()
    computed(live)
    newest_review = live.solver.review
    late_review.set_result(old_review)
    update(live)
    assert live.solver.review is newest_review


@pytest.mark.thorough
def test_of_two_answers_the_last_asked_for_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    live = fed()
    live.worker.call(live.evaluate_all)
    jobs, submit = [], live.pool.submit
    monkeypatch.setattr(live.pool, 'submit', lambda *args: jobs.append((Future(), args))
                        or jobs[-1][0])
    first = live.worker.call(live.solver.compute_calibration)
    live.remove_last_sample()
    second = live.worker.call(live.solver.compute_calibration)
    for future, args in reversed(jobs):
        future.set_result(submit(*args).result())
    assert first.result(PATIENCE) != second.result(PATIENCE)
    status = state_of(live)['calibration']
    assert status['state'] == 'current' and second.result().startswith(status['text'])


def test_a_recomputation_whose_process_is_killed_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    live, ended = fed(), Future()
    computed(live)
    ended.set_exception(PoolEndedError())
    monkeypatch.setattr(live.pool, 'submit', lambda *args: ended)
    changed(live, noise__sensor=5e-5)
    assert 'ended before it had an answer' in state_of(live)['session']['trouble']


@pytest.mark.thorough
def test_work_that_fails_is_reported_and_the_next_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    live = fed()
    live.start()
    monkeypatch.setattr(solver, 'extremes', lambda points: 1 / 0)

    def trouble_after(noise: float) -> str:
        live.worker.call(lambda: live.configure(set_to(live.config, noise__sensor=noise)))
        # behind each of these calls the worker does what is due: a stop, and in the end the review
        for _ in range(len(live.session.stops) + 3):
            live.worker.call(lambda: None)
        return state_of(live)['session']['trouble']

    assert 'ZeroDivisionError' in trouble_after(4e-5)
    monkeypatch.undo()
    assert trouble_after(3e-5) == ''


# -- the processes for long computations: what they answer, and what a killed one costs


@pytest.fixture
def pool() -> Pool:
    return Pool()


def test_it_answers_and_refuses_in_another_process(pool: Pool) -> None:
    assert pool.submit(divmod, 7, 2).result() == (3, 1)
    assert pool.submit(os.getpid).result() != os.getpid()
    assert pool.submit(os.nice, 0).result() == os.nice(0) + 5
    with pytest.raises(DataError) as refusal:
        pool.submit(pipeline.calibrate, [], [], Config()).result()
    with pytest.raises(DataError) as local_refusal:
        pipeline.calibrate([], [], Config())
    assert str(refusal.value) == str(local_refusal.value)
    with pytest.raises(ZeroDivisionError):
        pool.submit(divmod, 1, 0).result()


def test_one_that_was_killed_is_started_again_once_for_a_call(pool: Pool) -> None:
    os.kill(pool.submit(os.getpid).result(), signal.SIGKILL)
    assert pool.submit(divmod, 7, 2).result() == (3, 1)
    with pytest.raises(PoolEndedError, match='ended before it had an answer'):
        pool.submit(os._exit, 1).result()
    assert pool.submit(divmod, 7, 2).result() == (3, 1)


def test_one_that_is_killed_disturbs_no_other_call(pool: Pool, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / 'pipe')
    reading = pool.submit(Path.read_text, tmp_path / 'pipe')
    with (tmp_path / 'pipe').open('w') as pipe:  # once the other process reads it
        with pytest.raises(PoolEndedError):
            pool.submit(os._exit, 1).result()
        pipe.write('read by one process to the end')
    assert reading.result(PATIENCE) == 'read by one process to the end'


PARENT = """
import os, signal
from handeye_ros.node.pool import Pool
if __name__ == '__main__':
    print(Pool().submit(os.getpid).result(), flush=True)
    signal.pause()  # until it is killed
"""


def test_a_pool_ends_with_a_node_that_is_killed(tmp_path: Path) -> None:
    script = tmp_path / 'parent.py'
    script.write_text(PARENT)
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as parent:
        child = int(parent.stdout.readline())
        descriptor = os.pidfd_open(child)
        parent.kill()
    assert select.select([descriptor], [], [], PATIENCE)[0]
    os.close(descriptor)
