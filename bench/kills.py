# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Kills a running session at random moments, and counts what is lost of what was acknowledged.

    .venv/bin/python bench/kills.py

The process runs the session of the node, fed directly instead of over ROS;
test/node/test_cell.py kills the node itself. After each SIGKILL the session has to be
readable, by handeye and by stock readers of rosbag2 and mcap, hold every sample that was
acknowledged and not removed, and go on.
"""
from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
import os
from pathlib import Path
import random
import signal
import sys
import tempfile
import time
import traceback
from typing import Any

from handeye_ros.bags.bag_write import cloud_cdr
from handeye_ros.bags.session import files_of, OutputFolders, read_session, resumed, SessionFiles
from handeye_ros.config import Config, with_values
from handeye_ros.data import Profile, TimedPose
from handeye_ros.errors import HandeyeError
from handeye_ros.node.live import LiveSession
from handeye_ros.node.pool import Pool
from handeye_ros.sampling.features import sample_of
from mcap.reader import make_reader
import numpy as np
from rosbags.highlevel import AnyReader

NS = 1_000_000_000
KILLS_OF_A_SESSION = 10  # then another begins, as reading hundreds of samples takes its time
LONGEST = 0.5  # s until a kill
WORKING = 0.8  # share of kills of which this time begins with the first acknowledgement
REMOVING, REMOVED, TAKEN = 'removing', 'removed', 'taken'
SETTINGS = {'target.type': 'sphere', 'target.radius': 0.04, 'sampling.mode': 'manual',
            'sampling.new_translation': 0.0,
            'session': 'last'}


@dataclass
class Tally:
    """What is known of a session from what it acknowledged; removing: may be gone or not."""

    taken: set[int] = field(default_factory=set)
    removing: set[int] = field(default_factory=set)
    removed: set[int] = field(default_factory=set)

    def hear(self, text: str) -> None:
        """Take the acknowledgements in a text, one a line; the last may be cut off."""
        for line in text.splitlines(keepends=True):
            if line.endswith('\n'):
                what, number = line.split()
                getattr(self, what).add(int(number))


def profile(stamp: int) -> Profile:
    """Return a profile across the middle of a sphere of 40 mm radius."""
    x = np.linspace(-0.03, 0.03, 300)
    return Profile(stamp, 'laser', np.column_stack([x, 0.2 - np.sqrt(0.04**2 - x**2)]))


def stop(start: int, place: float) -> Iterator[TimedPose | Profile]:
    """Yield what is seen during a second of a robot that stands still at a place (m)."""
    for stamp in range(start, start + NS, NS // 20):
        yield TimedPose(stamp, np.array([place, 0.2, 0.3]), np.array([0.0, 0.0, 0.0, 1.0]))
        yield profile(stamp + 1)


class Inline(Pool):
    """Runs functions in this process, which is killed."""

    def submit(self, function: Any, *args: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(function(*args))
        except HandeyeError as error:
            future.set_exception(error)
        return future


def work(output_dir: Path, acknowledge: int) -> None:
    """Go on with the last session: take samples, and sometimes remove one, for ever."""
    config, found = resumed(SETTINGS | {'output_dir': str(output_dir)}, OutputFolders())
    live = LiveSession(config, OutputFolders(), SessionFiles(OutputFolders().folder, found),
                       Inline(), lambda: None)
    if found:
        live.restore(found.session(config), found.config)
    rng, start = random.Random(), time.time_ns()
    while True:
        start += 2 * NS
        for item in stop(start, rng.uniform(0, 10)):
            if isinstance(item, TimedPose):
                live.add_poses([item])
            else:
                live.add_profile(item)
        number = int(live.take_sample().split()[1])
        os.write(acknowledge, f'{TAKEN} {number}\n'.encode())
        if rng.random() < 0.2:
            os.write(acknowledge, f'{REMOVING} {number}\n'.encode())
            number = int(live.remove_last_sample().split()[2].rstrip(','))
            os.write(acknowledge, f'{REMOVED} {number}\n'.encode())


def killed(output_dir: Path, rng: random.Random) -> str:
    """Let a process work for a while and kill it; return what it acknowledged."""
    ours, its = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(ours)
        try:
            work(output_dir, its)
        except (HandeyeError, OSError):
            traceback.print_exc()
        finally:
            os._exit(1)
    os.close(its)
    # some are killed while they start, most while they work
    said = os.read(ours, 1000) if rng.random() < WORKING else b''
    time.sleep(rng.uniform(0, LONGEST))
    os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    with os.fdopen(ours, 'rb') as stream:
        said += stream.read()
    if os.WTERMSIG(status) != signal.SIGKILL:
        raise SystemExit('the session ended by itself')
    return said.decode()


def check(folder: Path, tally: Tally, config: Config, fewest: int = 6) -> None:
    """
    Raise AssertionError where something acknowledged is lost, or cannot be read.

    fewest: profiles of the newest sample.
    """
    found = read_session(folder)
    lost = tally.taken - tally.removing - set(found.stops)
    assert not lost, f'{folder}: samples {sorted(lost)} are lost'
    back = tally.removed & set(found.stops)
    assert not back, f'{folder}: the removed samples {sorted(back)} are back'
    newest = max(found.stops, default=0)
    if newest:
        assert sample_of(found.stops[newest][1], config).profiles >= fewest
    for file in files_of(folder):
        with file.open('rb') as stream:
            assert make_reader(stream).get_summary() is not None
    if (folder / 'metadata.yaml').exists():
        with AnyReader([folder]) as reader:
            assert sum(1 for _ in reader.messages()) == reader.message_count


def run(count: int, seed: int, output_dir: Path, report: bool = True) -> tuple[int, int]:
    """Kill so many times; return how many samples were acknowledged, and how many removed."""
    rng, taken, removed = random.Random(seed), 0, 0
    cloud_cdr(profile(0), Config())  # what is loaded once, the killed processes inherit
    config = with_values(Config(), {k: v for k, v in SETTINGS.items() if k != 'session'}, 'kills')
    for begun in range(0, count, KILLS_OF_A_SESSION):
        tally, parent = Tally(), output_dir / f'{begun:04d}'
        for _ in range(min(KILLS_OF_A_SESSION, count - begun)):
            tally.hear(killed(parent, rng))
            for folder in (parent / 'sphere').glob('*') if tally.taken else ():
                check(folder, tally, config)
        taken, removed = taken + len(tally.taken), removed + len(tally.removed)
        if report:
            print(f'{min(begun + KILLS_OF_A_SESSION, count)} kills: {taken} samples '
                  f'acknowledged, {removed} of them removed, none lost', flush=True)
    return taken, removed


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--count', type=int, default=200)
    parser.add_argument('--seed', type=int, default=0)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        run(options.count, options.seed, Path(folder))


if __name__ == '__main__':
    sys.exit(main())
