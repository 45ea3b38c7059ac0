"""
Whether a recording that gives no answer as it is set gives one with another setting.

Each hypothesis changes one setting, or two that belong together, and reads the same profiles of
the same stops again. The data then differ, and no likelihoods can be compared: a hypothesis counts
where nearly all its samples fit about as well as the configured noise allows, and where these are
most of the stops; of several that with the most conditions beyond its unknowns.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import permutations

from handeye_ros import targets
from handeye_ros.checks.alternatives import believable, Fit, Hypothesis, of_problem
from handeye_ros.checks.misfit import residual_rms
from handeye_ros.config import Config, with_assignments
from handeye_ros.data import Reject, Sample
from handeye_ros.errors import DataError, mm, NamedCauseError
from handeye_ros.estimation.linearise import Problem
from handeye_ros.estimation.solution import redundancy
from handeye_ros.frames import mounted
from handeye_ros.profiles.range_sign import range_sign_evidence
from handeye_ros.sampling.edge_shapes import consistent_edges
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.station_features import evenly
from handeye_ros.sampling.stops import needed, result_of, Seen, Stop

MOST_STOPS, MOST_PROFILES = 40, 4  # that are read again, and of each stop
LEAST_SHARE = 0.7  # of the stops that fit, at the least
FEWEST_CONDITIONS = 6  # beyond the unknowns
MORE = 1.5  # times the conditions of the setting as it is, where that fits too


class WrongSettingError(NamedCauseError):
    """Settings with which there is no answer, where others give one."""

    def __init__(self, values: dict[str, str], used: int, stops: int, residual: float) -> None:
        to = ' and '.join(f'{key} to {value}' for key, value in values.items())
        super().__init__(f'the recording does not fit as it is set, but with another setting '
                         f'{used} of {stops} stops agree within {mm(residual)} RMS: set {to}' + (
                             '; or, if the target has edges, cross them with the laser, inside '
                             'the field of view' if values == {'target.type': 'plane'} else ''))


def require_settings(session: Session, config: Config) -> None:
    """Raise WrongSettingError where other settings explain the stops of a session."""
    if config.sampling.moving:  # a pass is of many profiles, each with its own pose
        return
    stops = [_thinned(outcome.stop, config) for outcome in session.outcomes
             if not outcome.refused][:MOST_STOPS]
    stated = _fit(stops, config)
    least = MORE * _conditions(stated) if stated and believable(stated) else FEWEST_CONDITIONS
    best: tuple[int, Hypothesis, Fit] | None = None
    for values in _changes(config):
        one = _hypothesis(stops, config, values)
        fit = one.refit()
        count = _conditions(fit) if fit and believable(fit) else 0
        if fit and count >= least and len(fit[0].used) >= LEAST_SHARE * len(stops):
            if best is None or count > best[0]:
                best = count, one, fit
    if best:
        raise best[1].refusal(best[2])


def _changes(config: Config) -> Iterator[dict[str, str]]:
    """Yield the settings that may be meant, the likeliest first."""
    profile = config.profile
    sign = {'profile.range_sign': str(-profile.range_sign)}
    kinds = [{'target.type': name} for name in targets.METHODS if name != config.target.type]
    other = {'m': 'mm', 'mm': 'm'}[profile.unit]
    on_base = config.calibration_type == 'eye_on_base'
    axes = [{'profile.axes': f'[{a}, {b}]'} for a, b in permutations('xyz', 2)
            if (a, b) != tuple(profile.axes)]
    yield from (sign, {'profile.unit': other}, *kinds, *axes,
                {'calibration_type': 'eye_in_hand' if on_base else 'eye_on_base'})
    yield from (change | sign for change in (*kinds, *axes))


def _hypothesis(stops: Sequence[Stop], config: Config, values: dict[str, str]) -> Hypothesis:
    """Return that other values are meant."""
    def refusal(fit: Fit) -> DataError:
        return WrongSettingError(values, len(fit[0].used), len(stops),
                                 residual_rms(fit[0].solution))
    return Hypothesis(partial(_fit, stops, _changed(config, values)), refusal)


def _changed(config: Config, values: dict[str, str]) -> Config:
    """Return the configuration with other values; what was stated of another target is not."""
    if 'target.type' in values:
        config = replace(config, method='auto', target=replace(config.target, radius=0.0, size=()))
    return with_assignments(config, [f'{key}={value}' for key, value in values.items()])


def _fit(stops: Sequence[Stop], config: Config) -> Fit | None:
    """Return the fit of stops as a configuration reads them, None where there is none."""
    results: list[Sample | Reject] = [result_of(stop, config) for stop in stops]
    if range_sign_evidence(results).against:
        return None
    return fit_of([result for result in results if isinstance(result, Sample)], config)


def fit_of(samples: Sequence[Sample], config: Config) -> Fit | None:
    """Return what samples agree on, None where they are too few or fit nothing."""
    method = targets.method_for(config)
    ordered, _ = consistent_edges(samples)
    if len(ordered) < method.minimum:
        return None
    observations = method.features.observe(ordered)
    return of_problem(Problem(method, mounted(ordered, config), observations, config))


def _conditions(fit: Fit) -> int:
    """Return the number of independent conditions beyond the unknowns of a fit."""
    return redundancy(fit[0].solution)


def _thinned(stop: Stop, config: Config) -> Stop:
    """Return a stop with a few of the profiles of its still time."""
    seen = needed(stop, config).load(config)
    few = Seen(seen.poses, tuple(evenly(seen.profiles, MOST_PROFILES)))
    return Stop(stop.began, lambda config: few)
