"""The answer of a running session, and whether it still is one."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.data import Calibration
from handeye_ros.diagnosis.summaries import calibration_summary, changes_since
from handeye_ros.sampling.state import CalibrationState, CURRENT, NONE, OUTDATED, WITHDRAWN
import numpy as np

NO_ANSWER = 'no calibration has been computed yet'


class Answer:
    """The last answer that was not refused, and from which samples it came."""

    def __init__(self) -> None:
        """Start with none."""
        self.calibration: Calibration | None = None
        self._solved: frozenset[int] = frozenset()  # stamps of its samples
        self._withdrawn = ''

    def found(self, calibration: Calibration, solved: frozenset[int]) -> None:
        """Take the answer from the samples of these stamps."""
        self.calibration, self._solved, self._withdrawn = calibration, solved, ''

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
            found.parent_frame, found.child_frame, _plain(T[:3, 3]), _plain(se3.quaternion(T)),
            _plain(se3.rpy(T)), _plain(np.sqrt(np.diag(found.covariance))),
            quality.residual_rms, quality.holdout_rms, quality.samples_used,
            quality.samples_rejected)


def _plain(values: object) -> tuple[float, ...]:
    return tuple(float(value) for value in np.asarray(values))
