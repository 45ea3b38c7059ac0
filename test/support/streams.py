# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Streams of poses and profiles of a robot that stops, and sessions that take them."""
from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any

from handeye_ros.config import Config, with_values
from handeye_ros.data import Array, EdgePoint, NS, Profile, Reject, Sample, TimedPose
from handeye_ros.errors import DataError
from handeye_ros.sampling.features import result_of
from handeye_ros.sampling.session import Session
import numpy as np
from profiles import drawn, face, step_up_to, with_lost

START = 1_700_000_000_000_000_000
GOOD = with_lost(drawn(step_up_to(0.002)))[::4]
BAD = with_lost(drawn(face))[::4]  # a face without an edge
CONFIG = with_values(Config(), {'sampling.new_translation': 0.0}, 'test')
MANUAL = with_values(CONFIG, {'sampling.mode': 'manual'}, 'test')


def pose(time: float, x: float = 0.0, turn: float = 0.0, frame: str = 'base') -> TimedPose:
    return TimedPose(START + round(time * NS), np.array([x, 0.2, 0.3]),
                     np.array([0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2)]), frame)


def profile(time: float, points: Array = GOOD, frame: str = 'laser') -> Profile:
    return Profile(START + round(time * NS), frame, points)


def stops(*spans: tuple[float, float], rate: float = 50.0) -> list[TimedPose]:
    """Return poses of a robot that stands still during the spans (s) and moves in between."""
    poses = []
    for t in np.arange(spans[0][0], spans[-1][1] + 1e-9, 1 / rate).round(9):
        index = sum(t > end for _, end in spans)
        inside = spans[index][0] <= t
        poses.append(pose(t, x=0.1 * index if inside else 0.1 * index - 0.05 + 0.02 * (t % 1)))
    return poses


def profiles(start: float, end: float, rate: float = 20.0, points: Array = GOOD
             ) -> list[Profile]:
    return [profile(t, points) for t in np.arange(start, end, 1 / rate) + 0.003]


def in_order(*streams: Sequence[Any]) -> list[Any]:
    """Return the messages of streams as they arrive: in the order of their stamps."""
    return sorted(chain(*streams), key=lambda item: item.stamp)


def played(poses: Sequence[TimedPose], profiles: Sequence[Profile], config: Config = CONFIG,
           finish: bool = True) -> Session:
    """Return a session that took both streams in the order of their stamps."""
    session = Session(config)
    go_on(session, in_order(poses, profiles), config)
    if finish:
        session.evaluate_remaining()
    return session


def go_on(session: Session, items: Sequence[TimedPose | Profile], config: Config = CONFIG) -> None:
    """Add messages, and evaluate each stop that they complete, as the node does."""
    for item in items:
        add(session, item)
        collect(session, config)


def collect(session: Session, config: Config = CONFIG) -> None:
    """Evaluate the stops that were completed since the last call, as the node does."""
    for stop in session.take_completed():
        session.add_stop(session.with_result(stop, result_of(stop, config)))


def add(session: Session, item: TimedPose | Profile) -> None:
    if isinstance(item, TimedPose):
        session.add_pose(item)
    else:
        session.add_profile(item)


def taken(session: Session, config: Config = CONFIG) -> Sample:
    """Return the sample of the current stop, put into the session as on request."""
    stop = session.stop_on_request()
    stop = session.with_result(stop, result_of(stop, config))
    if isinstance(stop.result, Reject):
        raise DataError(stop.result.reason)
    session.add_stop(stop)
    session.mark_done(stop)
    return stop.result


def key(session: Session) -> list[tuple[object, ...]]:
    """Return all that the results of stops say, in the order of their numbers."""
    return [(o.stamp, o.reason) if isinstance(o, Reject) else (
        o.stamp, o.T_base_flange.tobytes(), o.profile_count,
        tuple((f.point.tobytes(), f.std) if isinstance(f, EdgePoint) else f.centre.tobytes()
              for f in o.features)) for o in (stop.result for stop in session.stops)]
