"""Stops that bring nothing new: the robot was there before."""
from __future__ import annotations

from collections.abc import Iterable

from handeye_ros import se3
from handeye_ros.config import Config
from handeye_ros.data import Sample
from handeye_ros.sampling.stops import Outcome
import numpy as np


def nothing_new(sample: Sample, others: Iterable[Outcome], config: Config) -> str:
    """Return of which other stop a sample only repeats the pose; empty if of none."""
    limits = config.sampling
    for other in others:
        if other.sample:
            distance, angle = apart(sample, other.sample)
            if distance < limits.new_translation and angle < limits.new_rotation:
                return (f'{distance * 1e3:.0f} mm and {np.degrees(angle):.1f} degrees from '
                        f'sample {other.number}: it brings nothing new')
    return ''


def apart(sample: Sample, other: Sample) -> tuple[float, float]:
    """Return how far the flange is from where it was at another sample (m, rad)."""
    T = se3.inverse(other.T_base_flange) @ sample.T_base_flange
    return float(np.linalg.norm(T[:3, 3])), float(np.linalg.norm(se3.log_rotation(T[:3, :3])))
