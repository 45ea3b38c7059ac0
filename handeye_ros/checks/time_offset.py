"""The time offset that a solution has found, and what is to be said of it."""
from __future__ import annotations

from handeye_ros.data import TimeOffset
from handeye_ros.estimation.solution import Solution
import numpy as np

TIME_OFFSET, ROTATION_LAG = 'time_offset', 'rotation_lag'  # the blocks of them
UNKNOWN = 0.5  # of its prior sigma: the motion says nothing of it
POOR = 5e-4  # s, 1 sigma
FAST = 0.1  # m/s, for which an offset is told as a length
SURE, LARGE_LAG = 4.0, 3e-4  # sigmas and s of a lag that is told


def time_offset_of(solution: Solution) -> TimeOffset | None:
    """Return the time offset of the stamps as received, None where the robot only stood."""
    found = _found(solution, TIME_OFFSET)
    return found and TimeOffset(solution.problem.config.time_offset + found.value, found.std)


def offset_notes(solution: Solution) -> list[str]:
    """Return what is to be said of offset and lag, in words."""
    offset, lag = _found(solution, TIME_OFFSET), _found(solution, ROTATION_LAG)
    if offset is None:
        return []
    notes = []
    if offset.std > UNKNOWN * solution.problem.config.time_offset_std:
        notes.append('the motion says nothing of the time offset, which is as time_offset and '
                     'time_offset_std state it: sweep across the target, with changes of speed')
    elif offset.std > POOR:
        notes.append(f'sweep faster once: the time offset is known to {offset.std * 1e3:.1f} ms '
                     f'only, that is {offset.std * FAST * 1e3:.2f} mm at {FAST * 1e3:.0f} mm/s')
    if lag and abs(lag.value) > max(SURE * lag.std, LARGE_LAG):
        notes.append(f'the robot reports its rotation {lag.value * 1e3:.2f} ms later than its '
                     'position: a scan with this calibration allows for it')
    return notes


def _found(solution: Solution, name: str) -> TimeOffset | None:
    """Return the value and 1 sigma of a block of one parameter, None where there is none."""
    both = []
    for source in (solution, solution.conservative or solution):
        names = [block.name for block in source.blocks]
        if name not in names:
            return None
        block = source.blocks[names.index(name)]
        first = sum(b.count for b in source.blocks[:names.index(name)])
        std = float(np.diag(source.covariance)[source.unknowns + first]) ** 0.5
        both.append((float(source.nuisance[first]) * block.std, std * block.std))
    (value, _), (other, std) = both
    return TimeOffset(value, float(np.hypot(std, other - value)))
