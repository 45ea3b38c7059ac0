"""The time offset of a sweep against that of a calibration, and the samples of it to check."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import math

from handeye_ros.data import Calibration, Sample, TimeOffset
from handeye_ros.verification.check import Check

SURE = 4.0  # sigmas of a change
SMALLEST = 1e-4  # s: of no matter to a scan
KEPT = 30  # samples of a sweep: neighbours share the errors of the robot


def with_offset(found: Check, now: TimeOffset, calibration: Calibration) -> Check:
    """Return a check with what a sweep says of the time offset."""
    before = calibration.time_offset
    if before is None:
        return found
    change, std = now.value - before.value, math.hypot(now.std, before.std)
    found = replace(found, time_offset_changed=change, time_offset_changed_std=std)
    told = f'{change * 1e3:+.2f} ms (1 sigma {std * 1e3:.2f})'
    if abs(change) <= max(SURE * std, SMALLEST):
        return replace(found, sentence=f'{found.sentence}. The time offset is as it was: {told}')
    said = (f'the time offset has changed by {told}: the clock or the delay of sensor or robot is '
            f'another; set time_offset to {now.value:.5f}, or calibrate again')
    if found.verdict == 'unchanged':
        return replace(found, verdict='clock', sentence=f'{said}. Apart from it {found.sentence}')
    return replace(found, verdict=f'{found.verdict} and clock',
                   sentence=f'{found.sentence}; {said}')


def some_of(samples: Sequence[Sample]) -> list[Sample]:
    """Return some of the samples of a sweep, evenly spread, as if the robot had stopped there."""
    every = -(-len(samples) // KEPT)
    return [replace(sample, motion=None) for sample in samples[every // 2::every]]
