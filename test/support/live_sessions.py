# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Running sessions without ROS that are given recordings."""
from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
import tempfile

from cells import Recorded, recorded, set_to
from handeye_ros.config import Config
from handeye_ros.data import TimedPose
from handeye_ros.node.folders import OutputFolders, settings_and_session
from handeye_ros.node.live import LiveSession
from handeye_ros.node.pool import Pool
from handeye_ros.sampling.stops import StopFinder
from streams import in_order

SPHERE = recorded('sphere')
PLACES = []  # folders of sessions that name none, until the tests end


def parted(recording: Recorded, count: int) -> list[Recorded]:
    """Return the recording of the first so many stops, and that of the rest."""
    finder = StopFinder(recording.config.sampling)
    ends = [stop.end for pose in recording.poses if (stop := finder.add(pose))]
    return [replace(recording, **{name: tuple(
        item for item in getattr(recording, name) if (item.stamp > ends[count - 1] + 1) == in_rest)
        for name in ('profiles', 'poses')}) for in_rest in (False, True)]


PARTS = parted(SPHERE, 8)
TO_VERIFY = set_to(SPHERE.config, verify__routine='sphere', verify__radius=0.04,
                   verify__tolerance=2e-3, verify__angle_tolerance=0.02)


class Inline(Pool):
    """Runs functions in this process."""

    def start(self) -> None:
        """Do nothing: there is no process."""

    def submit(self, function, *args) -> Future:
        future = Future()
        try:
            future.set_result(function(*args))
        except Exception as error:  # noqa: BLE001 - as that of another process
            future.set_exception(error)
        return future


def new(config: Config = SPHERE.config, pool: Pool | None = None,
        changed: Callable[[], object] = lambda: None) -> LiveSession:
    """Return a session without messages; it continues that of config.session."""
    if not config.output_dir:
        PLACES.append(tempfile.TemporaryDirectory())
        config = replace(config, output_dir=PLACES[-1].name)
    folders, stored = OutputFolders(), None
    if config.session:
        _, stored = settings_and_session(
            {'output_dir': config.output_dir, 'session': config.session}, folders)
    live = LiveSession(config, folders, pool or Inline(), changed)
    if stored:
        live.open_session(stored, config)
    return live


def fed(config: Config = SPHERE.config, recording=SPHERE) -> LiveSession:
    """Return a session that was given a recording in the order of its stamps."""
    live = new(config)
    feed(live, [*recording.poses, *recording.profiles])
    return live


def feed(live: LiveSession, items) -> None:
    for item in in_order(items):
        feed_one(live, item)
    update(live)


def feed_one(live: LiveSession, item) -> None:
    if isinstance(item, TimedPose):
        live.add_poses([item])
    else:
        live.add_profile(item)


def update(live: LiveSession) -> None:
    """Let a session that was not started do what is due."""
    while live.worker.call(live.evaluate_next):
        pass
    live.worker.call(live.solver.review_if_changed)
    live.worker.call(lambda: None)  # the review has been put


def changed(live: LiveSession, **values: object) -> None:
    live.configure(set_to(live.config, **values))
    update(live)


def computed(live: LiveSession) -> str:
    """Return what the session says of a new answer."""
    return live.worker.call(live.solver.compute_calibration).result()


def verdict(live: LiveSession) -> str:
    """Return the verdict of the verification that is running."""
    return live.worker.call(live.verification.verify_result).result()


def later(items, seconds: int):
    return [replace(item, stamp=item.stamp + seconds * 10**9) for item in items]
