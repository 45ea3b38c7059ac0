# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether other settings explain the stops.

Each hypothesis changes one setting, or two that belong together, and reads the same profiles of
the same stops again. The opposite sign of the range is also tried where an answer is accepted: by
the features that each sample has with that sign (Sample.flipped).
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import permutations

from handeye_ros import targets
from handeye_ros.checks.hypotheses import Explanation, explanation_of_samples, Hypothesis
from handeye_ros.checks.refusals import UnexplainedError
from handeye_ros.config import Config, flipped_range, TargetConfig, with_assignments
from handeye_ros.data import EdgePoint, Sample
from handeye_ros.errors import DataError
from handeye_ros.sampling.edge_shapes import with_common_shape
from handeye_ros.sampling.features import result_of
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import evenly, Stop

STOPS_READ, PROFILES_READ = 40, 4  # stops read again, profiles of each
RANGE_SIGN, TARGET_TYPE = 'profile.range_sign', 'target.type'
Values = tuple[tuple[str, str], ...]  # of settings, by their keys


def setting_hypotheses(session: Session, config: Config, stated: Explanation
                       ) -> Iterator[Hypothesis]:
    """Yield the hypotheses that other settings explain the stops of a session."""
    stops = [stop for stop in session.stops if not stop.final_reason
             and not session.excludes(stop)][:STOPS_READ]
    few = [thinned(stop, config) for stop in stops]
    stamps = [stop.result.stamp for stop in stops]
    with_edge = {stop.sample.stamp for stop in stops if stop.sample and any(
        isinstance(feature, EdgePoint) for feature in stop.sample.features)}

    def read(profiles: int, as_changed: Config) -> list[Sample]:
        results = [result_of(replace(stop, profiles=stop.profiles[:profiles]), as_changed)
                   for stop in few]
        return with_common_shape([replace(result, stamp=stamp) for result, stamp in zip(
            results, stamps, strict=True) if isinstance(result, Sample)])

    fits = dict[Values, Explanation]()  # those that leave no doubt
    for values in _changes(config):
        as_changed = with_settings(config, dict(values))
        if 2 * len(read(1, as_changed)) < len(stops):
            continue  # most show nothing: read no more of them
        fit = explanation_of_samples(read(PROFILES_READ, as_changed), as_changed, stamps)
        if as_changed.target.type == 'plane':  # it explains no edge that is seen now
            fit = replace(fit, squares={stamp: q for stamp, q in fit.squares.items()
                                        if stamp not in with_edge})
        if fit.believable and fit.within_noise and all(
                part.is_determined and not len(part.indispensable_stations)
                for part in fit.parts):
            fits[values] = fit
    for values, fit in fits.items():
        # of the types of target those, too, by which more conditions agree
        others = [other for key, other in fits.items() if values[0][0] == TARGET_TYPE == key[0][0]
                  and values[1:] == key[1:] and len(other.squares) >= len(fit.squares)
                  and other.redundancy > fit.redundancy]
        yield Hypothesis(fit, settings_refusal(dict(values), stated, fit, others), len(values))


def settings_refusal(values: Mapping[str, str], stated: Explanation, fit: Explanation,
                     others: Sequence[Explanation] = ()) -> DataError:
    """Return the refusal that names values of settings with which the stops fit, and others."""
    named = ' and '.join(f'{key} {value}' for key, value in values.items())
    to = ' and '.join(f'{key} to {value}' for key, value in values.items())
    if 'target.radius' in values:
        to = (f'target.radius to {fit.parts[0].estimate.state[-1]:.4f}, which these stops show, '
              'or to 0 (unknown)')
    to += ''.join(f', or to {other.parts[0].full_problem.config.target.type}, if it is one'
                  for other in others)
    if values == {TARGET_TYPE: 'plane'}:
        to += '; or, if the target has edges, cross them inside the field of view'
    return DataError(f'{fit.in_words_beside(stated, named)}: set {to}', reason='settings')


def sign_hypothesis(samples: Sequence[Sample], config: Config, stated: Explanation, clocks: bool
                    ) -> Hypothesis:
    """
    Return the hypothesis that the range counts the other way, by features of the samples.

    Where neither sign explains them within the noise, something else may: its refusal is an
    UnexplainedError. samples: of the stations of the stated fit; clocks: of a sweep, those of the
    samples are in doubt too.
    """
    flipped = flipped_range(config)
    others = with_common_shape([replace(sample, features=sample.flipped) for sample in samples
                                if sample.flipped])
    stamps = [sample.stamp for sample in samples if sample.flipped is not None]
    fit = explanation_of_samples(others, flipped, stamps, clocks=clocks)
    values = {RANGE_SIGN: str(flipped.profile.range_sign)}
    if fit.within_noise:
        return Hypothesis(fit, settings_refusal(values, stated, fit))
    words = fit.in_words_beside(stated, f'{RANGE_SIGN} {values[RANGE_SIGN]}')
    return Hypothesis(fit, UnexplainedError(
        f'{words}, neither as well as the noise allows: check {RANGE_SIGN}, and that every sample '
        'shows the target itself and no clamp or second plate', reason='misfit'))


def _changes(config: Config) -> list[Values]:
    """Return the likely corrections of settings, the most likely first."""
    profile = config.profile
    sign = (RANGE_SIGN, str(-profile.range_sign))
    unit = ('profile.unit', {'m': 'mm', 'mm': 'm'}[profile.unit])
    kind = ('calibration_type', 'eye_on_base' if config.in_hand else 'eye_in_hand')
    types = [(TARGET_TYPE, name) for name in targets.TARGETS if name != config.target.type]
    axes = [('profile.axes', f'[{a}, {b}]') for a, b in permutations('xyz', 2)
            if (a, b) != tuple(profile.axes)]
    radius = [('target.radius', '0')] if config.target.radius else []
    return [*((one,) for one in (*radius, sign, unit, *types, *axes, kind)),
            *((one, sign) for one in (*types, *axes))]


def with_settings(config: Config, values: Mapping[str, str]) -> Config:
    """Return the configuration with other values; measures of another target are reset."""
    if TARGET_TYPE in values:
        config = replace(config, method='auto',
                         target=TargetConfig(setback_std=config.target.setback_std))
    return with_assignments(config, [f'{key}={value}' for key, value in values.items()])


def thinned(stop: Stop, config: Config) -> Stop:
    """Return a stop with a few of its profiles."""
    stop = stop.load(config).trimmed(config)
    return replace(stop, profiles=tuple(evenly(stop.profiles, PROFILES_READ)))
