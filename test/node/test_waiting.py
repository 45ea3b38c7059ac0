"""Nobody waits for what takes long: told by the order of events, never by the clock."""
from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread
from typing import Any

from cells import recorded
from command import PATIENCE
from handeye_ros.bags.session_store import OutputFolders
from handeye_ros.bags.session_writing import SessionStore
from handeye_ros.config import Config, with_values
from handeye_ros.data import TimedPose
from handeye_ros.errors import DataError, HandeyeError
from handeye_ros.node.live import LiveSession
from handeye_ros.node.status import state_of
from handeye_ros.node.worker import Evaluator, Runner, WorkerProcess
from handeye_ros.sampling.stops import judged
import pytest
from recordings import halves

SPHERE = recorded('sphere')
PARTS = halves(SPHERE, 8)


class Gate:
    """Runs things when it is opened, and tells that somebody waits for it."""

    def __init__(self) -> None:
        """Start open."""
        self._open, self.asked = Event(), Event()
        self._open.set()

    def run(self, function: Callable[..., Any], *args: Any, urgent: bool = False) -> Any:
        """Return what a function returns, later."""
        self.asked.set()
        assert self._open.wait(PATIENCE)
        return function(*args)

    def stop(self) -> None:
        """Let all go on."""
        self._open.set()

    @contextmanager
    def closed(self, ask: Callable[[], Any]) -> Iterator[list[Any]]:
        """Ask for something that waits; give what it tells, which comes afterwards."""
        self._open.clear()
        self.asked.clear()
        report: list[Any] = []

        def run() -> None:
            try:
                report.append(ask())
            except HandeyeError as error:
                report.append(error)

        thread = Thread(target=run)
        thread.start()
        try:
            assert self.asked.wait(PATIENCE)
            yield report
            assert not report, 'it waits still'
        finally:
            self._open.set()
            thread.join(PATIENCE)


def running(tmp_path: Path, second: Gate | None = None, judging: Gate | None = None,
            **values: object) -> LiveSession:
    config = with_values(SPHERE.config, {'output_dir': str(tmp_path)} | {
        key.replace('__', '.'): value for key, value in values.items()}, 'test')
    return LiveSession(config, OutputFolders(), SessionStore(OutputFolders().folder), second,
                       judging)


def feed(live: LiveSession, profiles: Any, poses: Any) -> None:
    for item in sorted([*poses, *profiles], key=lambda item: item.stamp):
        (live.add_poses([item]) if isinstance(item, TimedPose) else live.add_profile(item))


def changed(config: Config, key: str, value: object) -> Config:
    return with_values(config, {key: value}, 'test')


def everything_else(live: LiveSession) -> None:
    """Use what must not wait; the robot stands in a stop, and a sample of it was taken."""
    assert ' taken again, ' in live.samples.take()
    assert live.samples.remove_last().startswith('removed sample ')
    live.configure(changed(live.config, 'limits.translation', 0.004))
    saved = live.answer.save()
    assert str(live.folders.folder(live.config)) in saved
    assert saved.endswith('the calibration is computed again: save it again after that')


def test_nobody_waits_for_a_solve(tmp_path: Path) -> None:
    second = Gate()
    live = running(tmp_path, second, sampling__mode='manual')
    for part in range(2):
        stand(live, *PARTS[part])
    live.answer.compute()
    with second.closed(live.answer.compute) as report:
        assert live.progress.text == 'the calibration is computed'
        everything_else(live)
        live.clear_samples()
    assert 'cleared while the calibration was computed' in str(report[0])
    assert not live.progress.text


def stand(live: LiveSession, profiles: Any, poses: Any) -> None:
    """Take samples by hand of every stop of a recording."""
    for item in sorted([*poses, *profiles], key=lambda item: item.stamp):
        if isinstance(item, TimedPose):
            live.add_poses([item])
        else:
            live.add_profile(item)
            motion = live.copied().motion
            if motion and live.copied().is_standing and motion.still > 0.9:
                live.samples.take()


def test_nobody_waits_for_a_take_and_what_changes_meanwhile_counts(tmp_path: Path) -> None:
    judging = Gate()
    live = running(tmp_path, judging=judging, sampling__mode='manual')
    stand(live, *PARTS[0])
    before = live.copied().outcomes
    with judging.closed(live.samples.take) as report:
        live.configure(changed(live.config, 'sampling.min_points', 10_000))
    assert 'fewer than 10000 returns' in str(report[0]) and live.copied().outcomes == before
    live.configure(changed(live.config, 'sampling.min_points', 20))
    with judging.closed(live.samples.take) as report:
        live.clear_samples()
    assert isinstance(report[0], HandeyeError) and not live.copied().outcomes


def verifying(tmp_path: Path) -> tuple[LiveSession, Gate]:
    """Return what has seen all that a verification needs, and what will tell its verdict."""
    second = Gate()
    live = running(tmp_path, second, sampling__mode='manual', verify__routine='sphere',
                   verify__radius=0.04, verify__tolerance=2e-3, verify__angle_tolerance=0.02)
    stand(live, *PARTS[0])
    live.answer.compute()
    live.verification.begin()
    stand(live, *PARTS[1])
    return live, second


def test_nobody_waits_for_a_verdict(tmp_path: Path) -> None:
    live, second = verifying(tmp_path)
    with second.closed(live.verification.result) as report:
        assert live.progress.text == 'the calibration is verified'
        # the verification goes on until it has an answer, and stops count for it
        assert live.samples.take().startswith('sphere: ')
        assert live.samples.remove_last().startswith('removed sample ')
        live.configure(changed(live.config, 'limits.translation', 0.004))
        assert str(live.folders.folder(live.config)) in live.answer.save()
    assert report[0].startswith('sphere: PASS, ')
    assert live.samples.take().startswith('sample ')


def test_a_verification_that_was_ended_meanwhile_stays_ended(tmp_path: Path) -> None:
    live, second = verifying(tmp_path)
    with second.closed(live.verification.result) as report:
        live.configure(changed(live.config, 'verify.routine', ''))
        live.configure(changed(live.config, 'verify.routine', 'sphere'))
        live.verification.begin()
    assert report[0].startswith('sphere: PASS, ')
    assert any('verification (sphere) continues' in note for note in live.warnings), 'the next'


def test_that_the_robot_moves_is_reported_while_stops_wait_to_be_judged(tmp_path: Path) -> None:
    judging = Gate()
    live = running(tmp_path, judging=judging)
    feed(live, *PARTS[0])
    feed(live, [], PARTS[1][1][:1])
    with judging.closed(live.samples.evaluate_all):
        with pytest.raises(DataError, match='still'):
            live.samples.take()
        live.configure(changed(live.config, 'limits.translation', 0.004))
    assert state_of(live).taken >= 7


def test_stops_give_the_same_in_another_process_and_where_that_has_ended(tmp_path: Path) -> None:
    live = running(tmp_path)
    feed(live, *PARTS[0])
    waiting = list(live.streams.waiting)[:2]  # in memory
    live.samples.evaluate_all()
    outcomes = live.copied().outcomes[:2]  # on the disk
    assert len(waiting) == len(outcomes) == 2
    other = with_values(live.config, {'noise.sensor': 4e-5}, 'test')
    second = WorkerProcess()
    try:
        report = [described(Evaluator(second), waiting, outcomes, other)]
    finally:
        second.stop()
    report += [described(Evaluator(runner), waiting, outcomes, other)
               for runner in (second, Runner())]
    assert report[0] == report[1] == report[2]
    assert report[0][-1] == [repr(judged(outcome, other).sample) for outcome in outcomes]


def described(evaluator: Evaluator, stops: Any, outcomes: Any, config: Config) -> list[Any]:
    return [[repr(evaluator.result(stop, config)) for stop in stops],
            [repr(evaluator.sample(stop, config)) for stop in stops],
            [repr(evaluator.reevaluated(outcome, config).sample) for outcome in outcomes]]
