"""What a change of the settings asks for: nothing, another solve, or other features."""
from __future__ import annotations

from handeye_ros.config import Config, flatten

# Keys, or the beginnings of keys, that say what a stop gives.
OF_SAMPLES = ('method', 'profile.', 'target.', 'noise.sensor', 'sampling.min_points',
              'sampling.settle_time', 'time_offset')
# The same of what the answer from given samples is.
OF_ANSWER = (*OF_SAMPLES, 'calibration_type', 'noise.', 'limits.', 'samples.',
             'sampling.min_crossing_angle')


def changes_samples(before: Config, after: Config) -> bool:
    """Tell whether the stops have to be extracted anew."""
    return _changes(before, after, OF_SAMPLES)


def changes_answer(before: Config, after: Config) -> bool:
    """Tell whether the samples have to be solved again."""
    return _changes(before, after, OF_ANSWER)


def changes_advice(before: Config, after: Config) -> bool:
    """Tell whether other poses are advised."""
    return _changes(before, after, ('guidance.',))


def _changes(before: Config, after: Config, keys: tuple[str, ...]) -> bool:
    old, new = flatten(before), flatten(after)
    return any(old[key] != new[key] for key in new if key.startswith(keys))
