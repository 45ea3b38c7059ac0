# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A robot with a sensor that streams as drivers do, in real time, and goes where it is told."""
from __future__ import annotations

from pathlib import Path
import sys
import threading
import time

from handeye_ros import se3
from handeye_ros.simulate import sensor
from handeye_ros.simulate.scenes import SCENES
import numpy as np
from ros_clouds import cloud
from ros_helpers import Client, cloud_message, pose_message, XZ
from scipy.spatial.transform import Rotation, Slerp

sys.path.insert(0, str(Path(__file__).parents[2] / 'bench'))
from guidance import ROBOTS, World, world  # noqa: E402, I100

POSES, EVERY = 50.0, 3  # poses a second; one profile for so many
SPEED, TURN = 0.15, 0.8  # m/s, rad/s


class LiveCell:
    """A cell of bench/guidance.py whose messages come from a thread; close ends it."""

    def __init__(self, client: Client, target: str, seed: int = 1) -> None:
        """Begin to stream at the first pose."""
        self.world: World = world(target, ROBOTS['fine'], seed, {})
        self.T = self.first = self.world.samples[0].T_base_flange
        self._client, self._rng = client, np.random.default_rng(seed)
        self._error = np.zeros(6)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._stream, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the streams."""
        self._ended.set()
        self._thread.join()

    def go(self, goal: np.ndarray, share: float = 1.0) -> None:
        """Move to a pose, or so much of the way, and stop there."""
        start, apart = self.T, np.linalg.norm(goal[:3, 3] - self.T[:3, 3])
        turns = Slerp([0, 1], Rotation.from_matrix([start[:3, :3], goal[:3, :3]]))
        angle = float(se3.angle(start[:3, :3].T @ goal[:3, :3]))
        steps = max(2, int(POSES * max(apart / SPEED, angle / TURN)))
        for step in range(1, steps + 1):
            part = share * step / steps
            self.T = se3.transform(turns(part).as_matrix(),
                                   start[:3, 3] + part * (goal[:3, 3] - start[:3, 3]))
            self._ended.wait(1 / POSES)
        self._error = 2e-5 * self._rng.normal(size=6)

    def _stream(self) -> None:
        count, due = 0, time.monotonic()
        while not self._ended.is_set():
            T, stamp, count = self.T, time.time_ns(), count + 1
            reported = T @ se3.transform(se3.exp_rotation(self._error[3:]), self._error[:3])
            self._client.poses.publish(
                pose_message(stamp, reported[:3, 3], se3.quaternion(reported)))
            if count % EVERY == 0:
                self._client.profiles.publish(self._profile(T, stamp))
            due += 1 / POSES
            self._ended.wait(max(0.0, due - time.monotonic()))

    def _profile(self, T: np.ndarray, stamp: int) -> object:
        cell = self.world
        T = se3.inverse(cell.T_base_target) @ T @ cell.T_flange_sensor
        z, angle = sensor.render(cell.scenario.sensor, SCENES[cell.scenario.scene].solids(
            cell.scenario), T[None])
        points, = sensor.plane_points(cell.scenario.sensor, sensor.measure(
            cell.scenario.sensor, z, angle, self._rng))
        return cloud_message(cloud({'x': points[:, 0], 'z': points[:, 1]}, XZ, 8), stamp)
