"""The robot on its way: stamps, and poses between the stops."""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.simulate.scenario import RobotModel
import numpy as np
from numpy.typing import NDArray

START = 1_700_000_000_000_000_000
STAMP = np.int64


@dataclass(frozen=True)
class Timeline:
    """A stop of dwell at each of n stations, and a motion between each two; seconds."""

    stations: int
    dwell: float
    move: float

    @property
    def duration(self) -> float:
        """From the arrival at the first station to the departure from the last."""
        return self.stations * self.dwell + (self.stations - 1) * self.move

    def spans(self) -> NDArray[STAMP]:
        """Return (n, 2) stamps of standing still."""
        starts = np.arange(self.stations) * (self.dwell + self.move)
        return stamps(np.stack([starts, starts + self.dwell], axis=1))

    def place(self, times: Array) -> tuple[NDArray[STAMP], Array]:
        """Return the station (k,) last stood at, and the share (k,) of the way to the next."""
        period = self.dwell + self.move
        station = np.minimum((times / period).astype(np.int64), self.stations - 1)
        s = np.clip((times - station * period - self.dwell) / self.move, 0.0, 1.0)
        s = np.where(station == self.stations - 1, 0.0, s)
        return station, s**3 * (10 - 15 * s + 6 * s**2)  # starts and stops without a jerk


def timeline(robot: RobotModel, stations: int) -> Timeline:
    """Return the timeline of a recording."""
    return Timeline(stations, robot.dwell, robot.move)


def stamps(times: Array) -> NDArray[STAMP]:
    """Return integer nanoseconds of seconds since the start."""
    return START + np.round(times * 1e9).astype(np.int64)


def between(T: Array, station: NDArray[STAMP], share: Array) -> Array:
    """Return poses (k, 4, 4) at a share of the way from a station of T (n, 4, 4) to the next."""
    here, there = T[station], T[np.minimum(station + 1, len(T) - 1)]
    R = here[:, :3, :3]
    turn = se3.log_rotation(np.swapaxes(R, 1, 2) @ there[:, :3, :3])
    t = here[:, :3, 3] + share[:, None] * (there[:, :3, 3] - here[:, :3, 3])
    return se3.transform(R @ se3.exp_rotation(share[:, None] * turn), t)
