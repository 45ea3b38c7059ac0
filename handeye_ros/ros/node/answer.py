"""The answer of a running session, whether it still is one, and which settings change it."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.config import Config, flatten
from handeye_ros.data import Calibration
from handeye_ros.diagnosis.summaries import calibration_summary, changes_since
from handeye_ros.sampling.state import CalibrationState, CURRENT, NONE, OUTDATED, WITHDRAWN
import numpy as np

# Keys, or the beginnings of keys, that say what a stop gives.
OF_SAMPLES = ('method', 'profile.', 'target.', 'noise.sensor', 'sampling.min_points',
              'sampling.settle_time', 'time_offset', 'rotation_lag_std')
# The same of what the answer from given samples is.
OF_ANSWER = (*OF_SAMPLES, 'calibration_type', 'noise.', 'limits.', 'samples.',
             'sampling.min_crossing_angle')

NO_ANSWER = 'no calibration has been computed yet'


class Answer:
    """The last answer that was not refused, and from which samples it came."""

    def __init__(self) -> None:
        """Start with none."""
        self.calibration: Calibration | None = None
        self._solved: frozenset[int] = frozenset()  # stamps of its samples
        self._withdrawn = ''
        self._saved: tuple[Calibration, str] | None = None  # the last one, and where it is

    def replace(self, calibration: Calibration, solved: frozenset[int]) -> None:
        """Take the answer from the samples of these stamps."""
        self.calibration, self._solved, self._withdrawn = calibration, solved, ''

    def saved(self, calibration: Calibration, path: str) -> None:
        """Take note that an answer was written to a file."""
        self._saved = calibration, path

    def withdraw(self, why: str) -> None:
        """Let there be no answer any more."""
        self._withdrawn = (f'{why}; the transform that was published before is not the answer'
                           if self.calibration or self._withdrawn else '')
        self.calibration = None

    def changes(self, now: frozenset[int]) -> str:
        """Return how the samples of now differ from those of the answer, if they do."""
        return changes_since(self._solved, now)

    def state(self, now: frozenset[int]) -> CalibrationState:
        """Return the answer as plain values; now: the stamps of the samples."""
        if self.calibration is None:
            return CalibrationState(WITHDRAWN if self._withdrawn else NONE,
                                    self._withdrawn or NO_ANSWER)
        changes = self.changes(now)
        found, T = self.calibration, self.calibration.T_flange_sensor
        quality = found.quality
        return CalibrationState(
            OUTDATED if changes else CURRENT, calibration_summary(found) + changes,
            found.parent_frame, found.child_frame, plain(T[:3, 3]), plain(se3.quaternion(T)),
            plain(se3.rpy(T)), plain(np.sqrt(np.diag(found.covariance))),
            quality.residual_rms, quality.holdout_rms, quality.samples_used,
            quality.samples_rejected,
            self._saved[1] if self._saved and self._saved[0] is found else '')


def plain(values: object) -> tuple[float, ...]:
    """Return numbers that JSON and messages take."""
    return tuple(float(value) for value in np.asarray(values))


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
