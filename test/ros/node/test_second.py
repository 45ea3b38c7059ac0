"""The second process: what it is asked, what it answers, and that it ends when it should."""
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
from handeye_ros.config import Config
from handeye_ros.diagnosis.review import NoReviewError, review
from handeye_ros.ros.errors import SecondEndedError
from handeye_ros.ros.node.second import COMMAND, Here, Second
from handeye_ros.sampling.errors import SilentPosesError
import pytest


@pytest.fixture
def second() -> Iterator[Second]:
    found = Second()
    yield found
    found.stop()


def test_it_answers_and_refuses_as_here(second: Second) -> None:
    assert second.run(divmod, 7, 2) == Here().run(divmod, 7, 2) == (3, 1)
    assert second.run(os.getpid) != os.getpid()
    told = []
    for runner in (second, Here()):
        with pytest.raises(NoReviewError) as caught:
            runner.run(review, [], [], Config())
        told.append(str(caught.value))
    assert told[0] == told[1]
    assert str(second.run(SilentPosesError, 0.3)) == str(SilentPosesError(0.3))
    with pytest.raises(ZeroDivisionError) as error:
        second.run(divmod, 1, 0)
    assert 'function(*args)' in error.value.__notes__[0], 'the traceback over there is told'


def test_its_priority_counts_beside_this_process_and_ctrl_c_is_not_for_it() -> None:
    second = Second(5)
    try:
        assert second.run(os.nice, 0) == os.nice(0) + 5
        assert second.run(os.getsid, 0) == os.getsid(0), 'Linux compares within a session'
        assert second.run(os.getpgid, 0) != os.getpgid(0)
    finally:
        second.stop()


def test_what_it_prints_is_no_answer(second: Second, capfd: pytest.CaptureFixture[str]) -> None:
    assert second.run(print, 'hello') is None
    second.stop()
    assert capfd.readouterr() == ('', 'hello\n')


def test_one_that_was_killed_is_told_and_started_again(second: Second) -> None:
    pid = second.run(os.getpid)
    with pytest.raises(SecondEndedError, match='ended by signal 9 before it had an answer'):
        second.run(os.kill, pid, signal.SIGKILL)
    assert second.run(os.getpid) != pid


def test_what_cannot_be_sent_spoils_nothing_that_comes_next(second: Second) -> None:
    with pytest.raises(TypeError):
        second.run(len, (bytes(200_000), threading.Lock()))
    word = 'told twice, sent once'
    assert second.run(os.path.join, word, word) == os.path.join(word, word)


def test_what_is_urgent_is_the_next(second: Second, tmp_path: Path) -> None:
    gate, order = tmp_path / 'gate', []
    os.mkfifo(gate)
    first = threading.Thread(target=second.run, args=(gate.read_text,))
    first.start()
    until(lambda: second._busy)

    def ask(urgent: bool) -> None:
        second.run(divmod, 1, 1, urgent=urgent)
        order.append(urgent)

    later = [threading.Thread(target=ask, args=(False,)) for _ in range(3)]
    for thread in later:
        thread.start()
    later.append(threading.Thread(target=ask, args=(True,)))
    later[-1].start()
    until(lambda: second._urgent)
    gate.write_text('go on')
    for thread in (first, *later):
        thread.join(PATIENCE)
    assert order == [True, False, False, False]


def test_to_stop_it_ends_whatever_is_done(second: Second, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / 'gate')
    told: list[str] = []

    def ask() -> None:
        with pytest.raises(SecondEndedError) as error:
            second.run((tmp_path / 'gate').read_text)
        told.append(str(error.value))

    thread = threading.Thread(target=ask)
    thread.start()
    until(lambda: second._process)
    second.stop()
    thread.join(PATIENCE)
    assert told
    with pytest.raises(SecondEndedError):
        second.run(divmod, 1, 1)


KILLED = """
import os, signal, threading, time
from handeye_ros.ros.node.second import Second
second = Second()
print(second.run(os.getpid), flush=True)
threading.Thread(target=second.run, args=(time.sleep, 1000), daemon=True).start()
while not second._busy:
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
