"""
Common errors in conventions, tried out when an answer does not fit.

The one that makes the samples agree names the mistake.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from handeye_ros import se3
from handeye_ros.checks.alternatives import Fit, Hypothesis, of_problem, require_stated
from handeye_ros.checks.convention_errors import CONVENTION_ERRORS, INVERSE
from handeye_ros.checks.errors import (
    CalibrationTypeError,
    ConventionError,
    CountedWrongWayError,
    RangeSignError,
    ScatteredOrientationsError,
)
from handeye_ros.checks.misfit import misfit_of, MISFITTING, residual_rms
from handeye_ros.config import Config
from handeye_ros.data import Array, Reject, Sample
from handeye_ros.errors import DataError
from handeye_ros.estimation.consensus import Consensus
from handeye_ros.estimation.linearise import points_in_base, Problem
from handeye_ros.profiles.range_sign import range_sign_evidence
import numpy as np

UNSURE = 0.6  # variance factor, nuisance parameters as noise, that makes the sign uncertain
SCATTERED = 0.6  # mean of the cosines to the best direction, below which there is none


def require_range_sign(stations: Sequence[Sample | Reject], config: Config) -> None:
    """Raise CountedWrongWayError where the profiles alone show that the range is."""
    hint = range_sign_evidence(stations).hint(config)
    if hint:
        raise CountedWrongWayError(hint)


def require_conventions(problem: Problem, agreed: Consensus, flipped: Problem | None) -> None:
    """
    Refuse an answer that an error in the conventions explains better.

    flipped: the problem with the range counted the other way, if it can be posed.

    Raises RangeSignError, CalibrationTypeError, ConventionError or ScatteredOrientationsError.
    """
    misfit = misfit_of(problem, agreed)
    if flipped and (misfit.variance_factor > UNSURE or misfit.hopeless or agreed.unused_share):
        require_stated((agreed,), [_other_sign(flipped, misfit.rms)])
    if not misfit.hopeless and misfit.variance_factor < MISFITTING:
        return
    require_stated((agreed,), [
        _undone(problem, name, undo, misfit.rms) for name, change in CONVENTION_ERRORS.items()
        for undo in (change.undo, change.other) if undo])
    if misfit.hopeless and orientations_scatter(problem.poses):
        raise ScatteredOrientationsError(misfit.rms)


def _other_sign(flipped: Problem, before: float) -> Hypothesis:
    """Return that the range is counted the other way."""
    def refusal(fit: Fit) -> DataError:
        return RangeSignError(flipped.config.profile.range_sign, before,
                              residual_rms(fit[0].solution))
    return Hypothesis(partial(of_problem, flipped), refusal)


def _undone(problem: Problem, name: str, undo: Callable[[Array], Array], before: float
            ) -> Hypothesis:
    """Return that the poses were made with an error, which undo takes back."""
    on_base = problem.config.calibration_type == 'eye_on_base'
    poses = se3.inverse(undo(se3.inverse(problem.poses))) if on_base else undo(problem.poses)

    def refusal(fit: Fit) -> DataError:
        after, advice = residual_rms(fit[0].solution), CONVENTION_ERRORS[name].advice
        if name == INVERSE:
            other = 'eye_in_hand' if on_base else 'eye_on_base'
            if _mounted_on_base(fit[0]) != on_base:
                return CalibrationTypeError(other, before, after)
            advice += f'; or set calibration_type to {other}, if the sensor is mounted so'
        return ConventionError(name, before, after, advice)
    return Hypothesis(partial(of_problem, replace(problem, poses=poses)), refusal)


def _mounted_on_base(agreed: Consensus) -> bool:
    """
    Return whether the sensor seems to be fixed to the base, and not to the flange.

    What it sees is nearer to the flange than to the base, whichever of them it is fixed to.
    """
    problem, X = agreed.solution.problem, agreed.solution.estimate.X
    seen = problem.observations.points @ X[:3, [0, 2]].T + X[:3, 3]
    other = points_in_base(problem, X)
    return bool(np.linalg.norm(seen, axis=1).mean() > np.linalg.norm(other, axis=1).mean())


def orientations_scatter(poses: Array) -> bool:
    """
    Return whether no direction of the tool keeps to a side, in poses (n, 4, 4).

    A sensor that sees its target does keep to a side; wrapped angles are as good as random.
    """
    return float(np.linalg.norm(poses[:, :3, :3].mean(axis=0), 2)) < SCATTERED
