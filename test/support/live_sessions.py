"""Running sessions without ROS that are given recordings."""
from __future__ import annotations

from dataclasses import replace

from cells import recorded
from handeye_ros.bags.session_store import OutputFolders
from handeye_ros.config import Config, with_values
from handeye_ros.data import TimedPose
from handeye_ros.node.live import LiveSession

SPHERE = recorded('sphere')


def fed(config: Config = SPHERE.config, recording=SPHERE) -> LiveSession:
    """Return a session that was given a recording in the order of its stamps."""
    live = LiveSession(config, OutputFolders())
    feed(live, [*recording.poses, *recording.profiles])
    return live


def feed(live: LiveSession, items) -> None:
    for item in sorted(items, key=lambda item: item.stamp):
        if isinstance(item, TimedPose):
            live.add_poses([item])
        else:
            live.add_profile(item)
    live.update()


def changed(live: LiveSession, **values: object) -> None:
    dotted = {key.replace('__', '.'): value for key, value in values.items()}
    live.configure(with_values(live.config, dotted, 'test'))
    live.update()


def later(items, seconds: int):
    return [replace(item, stamp=item.stamp + seconds * 10**9) for item in items]
