# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Hypotheses about the configuration: the same profiles of the same stops, read with other settings.

Each changes one setting, or two that belong together. The opposite sign of the range is also tried
where an answer is accepted: by the features that each sample has with that sign
(Sample.flipped_features).
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import permutations

from handeye_ros import targets
from handeye_ros.arithmetic import evenly_spaced
from handeye_ros.checks.hypotheses import (
    explain_samples,
    Explanation,
    Hypothesis,
    stops_to_explain,
)
from handeye_ros.checks.refusals import UnexplainedError
from handeye_ros.config import Config, TargetConfig, with_assignments, with_flipped_range
from handeye_ros.data import EdgePoint, Sample
from handeye_ros.errors import DataError
from handeye_ros.sampling.features import result_of
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import Stop

MAX_STOPS, MAX_PROFILES = 40, 4  # read again: stops, profiles of each
RANGE_SIGN, TARGET_TYPE = 'profile.range_sign', 'target.type'
Values = tuple[tuple[str, str], ...]  # of settings, by their keys


def setting_hypotheses(session: Session, config: Config, baseline: Explanation
                       ) -> Iterator[Hypothesis]:
    """Yield the hypotheses that other settings explain the stops of a session."""
    stops = evenly_spaced(stops_to_explain(session), MAX_STOPS)
    stamps = [stop.result.stamp for stop in stops]
    thinned_stops = [with_few_profiles(stop, config) for stop in stops]
    show_edge = {sample.stamp for stop in stops if (sample := stop.sample) and any(
        isinstance(feature, EdgePoint) for feature in sample.features)}

    def samples_as(changed: Config, profiles: int) -> list[Sample]:
        results = [result_of(replace(stop, profiles=stop.profiles[:profiles]), changed)
                   for stop in thinned_stops]
        return [replace(result, stamp=stamp) for result, stamp in zip(results, stamps, strict=True)
                if isinstance(result, Sample)]

    certain = dict[Values, Explanation]()  # those that leave no doubt
    for values in _likely_changes(config):
        changed = with_correction(config, dict(values))
        if 2 * len(samples_as(changed, profiles=1)) < len(stops):
            continue  # most show nothing: read no more of them
        tried = explain_samples(samples_as(changed, MAX_PROFILES), changed, stamps)
        if changed.target.type == 'plane':  # it does not explain the edges that are seen now
            tried = replace(tried, left_out_squares={
                stamp: left_out for stamp, left_out in tried.left_out_squares.items()
                if stamp not in show_edge})
        if tried.believable and tried.within_noise and all(
                solution.posterior.is_determined and not len(solution.indispensable_stations)
                for solution in tried.solutions):
            certain[values] = tried
    for values, explanation in certain.items():
        other_types = [
            other for other_values, other in certain.items()
            if values[0][0] == TARGET_TYPE == other_values[0][0] and values[1:] == other_values[1:]
            and len(other.left_out_squares) >= len(explanation.left_out_squares)
            and other.redundancy > explanation.redundancy]
        refusal = settings_refusal(dict(values), baseline, explanation, other_types)
        yield Hypothesis(explanation, refusal, len(values))


def settings_refusal(values: Mapping[str, str], baseline: Explanation, with_values: Explanation,
                     other_types: Sequence[Explanation] = ()) -> DataError:
    """
    Return the refusal that names the values of settings with which the stops fit.

    with_values: as they fit with these; other_types: with other types of target, named too.
    """
    named = ' and '.join(f'{key} {value}' for key, value in values.items())
    to = ' and '.join(f'{key} to {value}' for key, value in values.items())
    if 'target.radius' in values:
        shown = with_values.solutions[0]
        radius = shown.problem.target.measures(shown.estimate.state)['radius']
        to = f'target.radius to {radius:.4f}, which these stops show, or to 0 (unknown)'
    to += ''.join(f', or to {other.solutions[0].full_problem.config.target.type}, if it is one'
                  for other in other_types)
    if values == {TARGET_TYPE: 'plane'}:
        to += '; or, if the target has edges, cross them inside the field of view'
    comparison = with_values.comparison_in_words(baseline, named)
    return DataError(f'{comparison}: set {to}', code='settings')


def sign_hypothesis(samples: Sequence[Sample], config: Config, baseline: Explanation, clocks: bool
                    ) -> Hypothesis:
    """
    Return the hypothesis that the range counts the other way, by features of the samples.

    Where neither sign explains them within the noise, something else may: its refusal is an
    UnexplainedError. samples: of the stations of the baseline; clocks: of a sweep, those of the
    samples are in doubt too.
    """
    flipped = with_flipped_range(config)
    flipped_samples = [replace(sample, features=sample.flipped_features)
                       for sample in samples if sample.flipped_features]
    stamps = [sample.stamp for sample in samples if sample.flipped_features is not None]
    explanation = explain_samples(flipped_samples, flipped, stamps, clocks=clocks)
    values = {RANGE_SIGN: str(flipped.profile.range_sign)}
    if explanation.within_noise:
        return Hypothesis(explanation, settings_refusal(values, baseline, explanation))
    words = explanation.comparison_in_words(baseline, f'{RANGE_SIGN} {values[RANGE_SIGN]}')
    return Hypothesis(explanation, UnexplainedError(
        f'{words}, neither as well as the noise allows: check {RANGE_SIGN}, and that every sample '
        'shows the target itself and no clamp or second plate', code='misfit'))


def _likely_changes(config: Config) -> list[Values]:
    """Return the likely corrections of settings, the most likely first."""
    profile = config.profile
    sign = (RANGE_SIGN, str(-profile.range_sign))
    unit = ('profile.unit', {'m': 'mm', 'mm': 'm'}[profile.unit])
    mounting = ('calibration_type', config.other_calibration_type)
    types = [(TARGET_TYPE, name) for name in targets.TARGETS if name != config.target.type]
    if config.method != 'auto':  # it overrules the type
        types = [('method', 'auto')]
    axes = [('profile.axes', f'[{a}, {b}]') for a, b in permutations('xyz', 2)
            if (a, b) != tuple(profile.axes)]
    radius = [('target.radius', '0')] if config.target.radius else []
    noise = ('noise.sensor', f'{min(10 * config.noise.sensor, 0.01):g}')
    singles = [*radius, sign, unit, noise, *types, *axes, mounting]
    return [*((change,) for change in singles), *((change, sign) for change in (*types, *axes))]


def with_correction(config: Config, values: Mapping[str, str]) -> Config:
    """
    Return the configuration with other values.

    Another target.type also resets method, and all of target but setback_std.
    """
    if TARGET_TYPE in values:
        config = replace(config, method='auto',
                         target=TargetConfig(setback_std=config.target.setback_std))
    return with_assignments(config, [f'{key}={value}' for key, value in values.items()])


def with_few_profiles(stop: Stop, config: Config) -> Stop:
    """Return a stop with a few of its profiles."""
    stop = stop.load(config).trimmed(config)
    return replace(stop, profiles=tuple(evenly_spaced(stop.profiles, MAX_PROFILES)))
