"""The worker process: what it is asked, what it answers, and that it ends when it should."""
from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import pickle
import signal
import subprocess
import sys
import threading
import time

from command import PATIENCE
from handeye_ros.checks.review import NoReviewError, review
from handeye_ros.config import Config
from handeye_ros.node.errors import WorkerEndedError
from handeye_ros.node.worker import (
    COMMAND,
    Evaluator,
    Runner,
    TRIM,
    trim_memory,
    WorkerProcess,
)
from handeye_ros.sampling.session import silent_poses
from handeye_ros.sampling.stops import evenly
import pytest

MESSAGES, SIZE = 4000, 15_000  # in memory: number, and bytes of each


@pytest.fixture
def worker() -> Iterator[WorkerProcess]:
    found = WorkerProcess()
    yield found
    found.stop()


def test_it_answers_and_refuses_as_here(worker: WorkerProcess) -> None:
    assert worker.run(divmod, 7, 2) == Runner().run(divmod, 7, 2) == (3, 1)
    assert worker.run(os.getpid) != os.getpid()
    result = []
    for runner in (worker, Runner()):
        with pytest.raises(NoReviewError) as caught:
            runner.run(review, [], [], Config())
        result.append(str(caught.value))
    assert result[0] == result[1]
    assert str(worker.run(silent_poses, 0.3)) == str(silent_poses(0.3))
    with pytest.raises(ZeroDivisionError) as error:
        worker.run(divmod, 1, 0)
    assert 'function(*args)' in error.value.__notes__[0], 'the traceback over there is told'


def test_its_priority_counts_beside_this_process_and_ctrl_c_is_not_for_it() -> None:
    worker = WorkerProcess(5)
    try:
        assert worker.run(os.nice, 0) == os.nice(0) + 5
        assert worker.run(os.getsid, 0) == os.getsid(0), 'Linux compares within a session'
        assert worker.run(os.getpgid, 0) != os.getpgid(0)
    finally:
        worker.stop()


def test_what_it_prints_is_no_answer(
        worker: WorkerProcess, capfd: pytest.CaptureFixture[str]) -> None:
    assert worker.run(print, 'hello') is None
    worker.stop()
    assert capfd.readouterr() == ('', 'hello\n')


def test_one_that_was_killed_is_reported_and_started_again(worker: WorkerProcess) -> None:
    pid = worker.run(os.getpid)
    with pytest.raises(WorkerEndedError, match='ended by signal 9 before it had an answer'):
        worker.run(os.kill, pid, signal.SIGKILL)
    assert worker.run(os.getpid) != pid


def test_one_that_is_suspended_is_ended_and_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    worker = WorkerProcess()
    try:
        pid = worker.run(os.getpid)
        with pytest.raises(WorkerEndedError, match=r'was suspended \(SIGSTOP\)'):
            worker.run(os.kill, pid, signal.SIGSTOP)
        assert worker.run(os.getpid) != pid
        evaluator, many = Evaluator(worker), list(range(100))
        assert evaluator._run(evenly, many, 5) and not evaluator.trouble
        monkeypatch.setattr(worker, 'run', lambda *_, **__: raised(WorkerEndedError(-9)))
        assert evaluator._run(evenly, many, 5) == evenly(many, 5)
        assert 'ended by signal 9' in evaluator.trouble and 'the node itself' in evaluator.trouble
    finally:
        worker.stop()


def raised(error: Exception) -> None:
    raise error


def test_what_cannot_be_sent_spoils_nothing_that_comes_next(worker: WorkerProcess) -> None:
    with pytest.raises(TypeError):
        worker.run(len, (bytes(200_000), threading.Lock()))
    word = 'told twice, sent once'
    assert worker.run(os.path.join, word, word) == os.path.join(word, word)


def test_what_is_urgent_is_the_next(worker: WorkerProcess, tmp_path: Path) -> None:
    gate, order = tmp_path / 'gate', []
    os.mkfifo(gate)
    first = threading.Thread(target=worker.run, args=(gate.read_text,))
    first.start()
    until(lambda: worker._busy)

    def ask(urgent: bool) -> None:
        worker.run(divmod, 1, 1, urgent=urgent)
        order.append(urgent)

    later = [threading.Thread(target=ask, args=(False,)) for _ in range(3)]
    for thread in later:
        thread.start()
    later.append(threading.Thread(target=ask, args=(True,)))
    later[-1].start()
    until(lambda: worker._urgent)
    gate.write_text('go on')
    for thread in (first, *later):
        thread.join(PATIENCE)
    assert order == [True, False, False, False]


def test_to_stop_it_ends_whatever_is_done(worker: WorkerProcess, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / 'gate')
    result: list[str] = []

    def ask() -> None:
        with pytest.raises(WorkerEndedError) as error:
            worker.run((tmp_path / 'gate').read_text)
        result.append(str(error.value))

    thread = threading.Thread(target=ask)
    thread.start()
    until(lambda: worker._process)
    worker.stop()
    thread.join(PATIENCE)
    assert result
    with pytest.raises(WorkerEndedError):
        worker.run(divmod, 1, 1)


KILLED = """
import os, signal, threading, time
from handeye_ros.node.worker import WorkerProcess
worker = WorkerProcess()
print(worker.run(os.getpid), flush=True)
threading.Thread(target=worker.run, args=(time.sleep, 1000), daemon=True).start()
while not worker._busy:
    pass
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_it_ends_with_a_process_that_is_killed() -> None:
    said = subprocess.run([sys.executable, '-c', KILLED], capture_output=True, text=True,
                          check=False)
    assert said.returncode == -signal.SIGKILL
    until(lambda: not Path(f'/proc/{int(said.stdout)}').exists())


def test_it_ends_quietly_where_nobody_listens_any_more() -> None:
    with subprocess.Popen((*COMMAND, '0'), stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE) as process:
        process.stdout.close()
        pickle.dump((divmod, (7, 2)), process.stdin)
        process.stdin.flush()  # and it stays open: who listens there is waiting
        assert process.wait(PATIENCE) == 0
        assert not process.stderr.read()


def until(condition) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def resident() -> int:
    """Return the resident memory of this process in bytes."""
    pages = Path('/proc/self/statm').read_text(encoding='utf-8').split()[1]
    return int(pages) * os.sysconf('SC_PAGE_SIZE')


@pytest.mark.skipif(TRIM is None, reason='this C library gives back by itself, or not at all')
def test_what_lies_between_kept_messages_is_given_back() -> None:
    messages = [bytes([i % 256]) * SIZE for i in range(MESSAGES)]
    kept = messages[::50]
    before = resident()
    del messages
    trim_memory()
    assert before - resident() > 0.7 * MESSAGES * SIZE
    assert all(len(message) == SIZE for message in kept)
