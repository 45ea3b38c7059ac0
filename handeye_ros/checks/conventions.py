"""
Common errors in conventions, tried out when an answer does not fit.

The one that makes the samples agree names the mistake.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from handeye_ros import se3
from handeye_ros.checks.convention_errors import CONVENTION_ERRORS, INVERSE
from handeye_ros.checks.errors import (
    CalibrationTypeError,
    ConventionError,
    CountedWrongWayError,
    RangeSignError,
    ScatteredOrientationsError,
)
from handeye_ros.checks.misfit import (
    LARGEST_DROPPED_SHARE,
    misfit_of,
    residual_rms,
    SUSPICIOUS,
)
from handeye_ros.config import Config
from handeye_ros.data import Array, Reject, Sample
from handeye_ros.estimation.consensus import Consensus, fast_consensus
from handeye_ros.estimation.linearise import points_in_base, Problem
from handeye_ros.estimation.quantiles import f_isf
from handeye_ros.profiles.range_sign import range_sign_evidence
import numpy as np

DOUBTFUL = 0.6  # variance factor, doubts included, from which the range's other sign is tried
BELIEVABLE = 4.0  # that undoing an error must lead to
FLIPPED_SHARE = 0.4  # of the residual that may be left with the range counted the other way
MANY = 0.3  # of the stations, that only one of two answers explains
CHANCE = 1e-5  # of naming an error where there is none
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
    if (misfit.variance_factor > DOUBTFUL or misfit.hopeless or agreed.unused_share) and flipped:
        _require_not_flipped(flipped, agreed, misfit.rms)
    if not misfit.hopeless and misfit.variance_factor < SUSPICIOUS:
        return
    tried = [(name, fast_consensus(_undone(problem, undo)))
             for name, change in CONVENTION_ERRORS.items()
             for undo in (change.undo, change.other) if undo]
    good = [(name, better) for name, better in tried
            if better and explains(better, agreed)]
    if good:
        name, better = min(good, key=lambda pair: pair[1].solution.variance_factor)
        raise _convention_error(name, better, misfit.rms)
    if misfit.hopeless and orientations_scatter(problem.poses):
        raise ScatteredOrientationsError(misfit.rms)


def _require_not_flipped(flipped: Problem, agreed: Consensus, before: float) -> None:
    other = fast_consensus(flipped)
    # both read the same points with the same doubts, which make both fit better than their noise
    if not other or not explains(other, agreed, floor=0.0):
        return
    after = residual_rms(other.solution)
    if after < FLIPPED_SHARE * before or _more(other, agreed):
        raise RangeSignError(flipped.config.profile.range_sign, before, after)


def _convention_error(name: str, better: Consensus, before: float
                      ) -> ConventionError | CalibrationTypeError:
    """Return the refusal that names an error, given what the samples agree on without it."""
    after = residual_rms(better.solution)
    on_base = better.solution.problem.config.calibration_type == 'eye_on_base'
    if name == INVERSE and _mounted_on_base(better) != on_base:
        return CalibrationTypeError('eye_in_hand' if on_base else 'eye_on_base', before, after)
    return ConventionError(name, before, after, CONVENTION_ERRORS[name].advice)


def _mounted_on_base(agreed: Consensus) -> bool:
    """
    Return whether the sensor seems to be fixed to the base, and not to the flange.

    What it sees is nearer to the flange than to the base, whichever of them it is fixed to.
    """
    problem, X = agreed.solution.problem, agreed.solution.estimate.X
    seen = problem.observations.points @ X[:3, [0, 2]].T + X[:3, 3]
    other = points_in_base(problem, X)
    return bool(np.linalg.norm(seen, axis=1).mean() > np.linalg.norm(other, axis=1).mean())


def _undone(problem: Problem, undo: Callable[[Array], Array]) -> Problem:
    """Return the problem with the poses as they would be without the error."""
    if problem.config.calibration_type == 'eye_on_base':
        return replace(problem, poses=se3.inverse(undo(se3.inverse(problem.poses))))
    return replace(problem, poses=undo(problem.poses))


def orientations_scatter(poses: Array) -> bool:
    """
    Return whether no direction of the tool keeps to a side, in poses (n, 4, 4).

    A sensor that sees its target does keep to a side; wrapped angles are as good as random.
    """
    return float(np.linalg.norm(poses[:, :3, :3].mean(axis=0), 2)) < SCATTERED


def explains(better: Consensus, agreed: Consensus, floor: float = 1.0) -> bool:
    """
    Return whether a cause explains what the answer does not, down to the configured noise.

    floor: of the variance factor, below which fitting better says nothing.

    By an F-test: few stations fit many things by chance.
    """
    if better.unused_share > LARGEST_DROPPED_SHARE or (
            better.solution.variance_factor > BELIEVABLE
            or better.explained < 0.8 * agreed.explained):
        return False
    gain = agreed.solution.variance_factor / max(better.solution.variance_factor, floor)
    freedom = (agreed.solution.degrees_of_freedom, better.solution.degrees_of_freedom)
    if min(freedom) < 1:
        return False
    return gain > f_isf(CHANCE, *freedom) or (
        gain > 0.1 and _more(better, agreed))


def _more(better: Consensus, agreed: Consensus) -> bool:
    """Return whether an answer explains far more of the stations than another."""
    return better.explained - agreed.explained > MANY * len(agreed.whole.poses)
