"""How a robot moves that does not stop, and what it then gets wrong."""
from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sweep:
    """
    A way through all stops without stopping, a knot of a smooth curve at each; seconds.

    exposure: that one profile averages over; rotation_lag: by which the reported rotation is
    late. stamp_jitter, pose_jitter: 1 sigma of the stamps. gaps: how many times no pose comes for
    a time gap. resolution: to which positions are rounded (m), 0: not. drift: RMS of the vectors
    of an error (translation, rotation) of the poses that varies smoothly over drift_time.
    """

    knot: float = 1.6
    exposure: float = 0.0
    rotation_lag: float = 0.0
    stamp_jitter: float = 0.0
    pose_jitter: float = 0.0
    gaps: int = 0
    gap: float = 0.3
    resolution: float = 0.0
    drift: tuple[float, float] = (0.0, 0.0)
    drift_time: float = 1.0
