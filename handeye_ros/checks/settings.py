# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Whether other settings explain a recording without an answer.

Each hypothesis changes one setting, or two that belong together, and reads the same profiles of
the same stops again.
"""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import permutations

from handeye_ros import targets
from handeye_ros.checks.hypotheses import (
    Explanation,
    explanation_of_results,
    Hypothesis,
    refuse_better,
)
from handeye_ros.checks.refusals import UnexplainedError
from handeye_ros.config import Config, flatten, flipped_range, with_assignments
from handeye_ros.data import EdgePoint, Sample
from handeye_ros.errors import DataError
from handeye_ros.sampling.edge_shapes import with_common_shape
from handeye_ros.sampling.features import result_of
from handeye_ros.sampling.session import Session
from handeye_ros.sampling.stops import evenly, Stop
import numpy as np

STOPS_READ, PROFILES_READ = 40, 4  # stops read again, profiles of each
RANGE_SIGN = 'profile.range_sign'


def require_settings(session: Session, config: Config) -> None:
    """Raise DataError (settings) where other settings explain the stops of a session better."""
    kept = [stop for stop in session.stops if not stop.final_reason and not session.excludes(stop)]
    stops = [thinned(stop, config) for stop in kept[:STOPS_READ]]
    results = [result_of(stop, config) for stop in stops]
    seen = with_common_shape([r for r in results if isinstance(r, Sample)])
    with_edge = {s.stamp for s in seen if any(isinstance(f, EdgePoint) for f in s.features)}
    edges = np.array([result.stamp in with_edge for result in results], dtype=bool)
    stated = explanation_of_results(results, config, all_starts=True)  # as a solve starts

    def fit_as(values: dict[str, str]) -> Explanation:
        """Return the fit of the stops, read with other values of settings."""
        as_changed = with_settings(config, values)
        glance = [result_of(replace(stop, profiles=stop.profiles[:1]), as_changed)
                  for stop in stops]
        if 2 * sum(isinstance(result, Sample) for result in glance) < len(stops):
            return Explanation.nothing(len(stops))  # most show nothing: read no more of them
        fit = explanation_of_results([result_of(stop, as_changed) for stop in stops], as_changed)
        if as_changed.target.type == 'plane':  # it explains no edge that is seen now
            fit = replace(fit, squares=np.where(edges, np.inf, fit.squares))
        return fit if within_noise(fit) else Explanation.nothing(len(stops))

    def refit(choices: Sequence[dict[str, str]]) -> Explanation:
        """Return the best fit, with those beside it by which more of the same stops agrees."""
        fits = [fit for fit in map(fit_as, choices) if fit.believable and fit.is_determined]
        if not fits:
            return Explanation.nothing(len(stops))
        best = max(fits, key=lambda fit: fit.evidence_over(stated))
        return replace(best, with_more_conditions=tuple(
            fit for fit in fits
            if fit.fitting >= best.fitting and fit.redundancy > best.redundancy))

    refuse_better(stated, [
        Hypothesis(partial(refit, choices), partial(settings_refusal, [*choices[0]], stated),
                   len(choices[0])) for choices in _changes(config)])


def settings_refusal(keys: Sequence[str], stated: Explanation, fit: Explanation) -> DataError:
    """Return the refusal that names the settings of some keys with which the stops fit."""
    solution = fit.parts[0]
    now = flatten(solution.full_problem.config)
    values = {key: '[{}, {}]'.format(*now[key]) if key == 'profile.axes' else f'{now[key]}'
              for key in keys}
    named = ' and '.join(f'{key} {value}' for key, value in values.items())
    to = ' and '.join(f'{key} to {value}' for key, value in values.items())
    if keys == ['target.radius']:
        named = 'target.radius 0'
        to = (f'target.radius to {solution.estimate.state[-1]:.4f}, which these stops show, or to '
              '0 (unknown)')
    to += ''.join(f', or to {richer.parts[0].full_problem.config.target.type}, if it is one'
                  for richer in fit.with_more_conditions)
    if values == {'target.type': 'plane'}:
        to += '; or, if the target has edges, cross them inside the field of view'
    return DataError(f'{fit.in_words_beside(stated, named)}: set {to}', reason='settings')


def require_sign(samples: Sequence[Sample], config: Config, stated: Explanation, clocks: bool
                 ) -> None:
    """
    Raise DataError (settings) where the opposite profile.range_sign explains stations better.

    Where neither sign explains them within the noise, something else may: an UnexplainedError.
    samples: of the stations of the stated fit, in order; compared are those with flipped features.
    clocks: of a sweep, those of the samples are in doubt too.
    """
    asked = [k for k, sample in enumerate(samples) if sample.flipped is not None]
    stated = replace(stated, squares=stated.squares[:, asked])
    others = [replace(samples[k], features=seen) if (seen := samples[k].flipped) else None
              for k in asked]
    flipped = flipped_range(config)

    def refusal(fit: Explanation) -> DataError:
        if within_noise(fit):
            return settings_refusal([RANGE_SIGN], stated, fit)
        other = f'{RANGE_SIGN} {flipped.profile.range_sign}'
        return UnexplainedError(
            f'{fit.in_words_beside(stated, other)}, neither as well as the noise allows: check '
            f'{RANGE_SIGN}, and that every sample shows the target itself and no clamp or second '
            'plate', reason='misfit')

    refuse_better(stated, [Hypothesis(
        partial(explanation_of_results, others, flipped, clocks=clocks), refusal)])


def within_noise(fit: Explanation) -> bool:
    """
    Return whether stops that were read anew fit as well as the noise predicts, in metres.

    Edges of another object, such as the floor beside the target, are uncertain: they fit in
    sigmas.
    """
    return all(part.residual_rms <= part.expected_rms for part in fit.parts)


def _changes(config: Config) -> Iterator[Sequence[dict[str, str]]]:
    """Yield the likely corrections of settings, the most likely first, each with its choices."""
    profile = config.profile
    sign = {RANGE_SIGN: str(-profile.range_sign)}
    kinds = [{'target.type': name} for name in targets.TARGETS if name != config.target.type]
    unit = {'m': 'mm', 'mm': 'm'}[profile.unit]
    kind = {'eye_on_base': 'eye_in_hand', 'eye_in_hand': 'eye_on_base'}[config.calibration_type]
    axes = [f'[{a}, {b}]' for a, b in permutations('xyz', 2) if (a, b) != tuple(profile.axes)]
    if config.target.radius:
        yield [{'target.radius': '0'}]
    yield from ([sign], [{'profile.unit': unit}], kinds,
                *([{'profile.axes': pair}] for pair in axes), [{'calibration_type': kind}])
    yield [choice | sign for choice in kinds]
    yield from ([{'profile.axes': pair} | sign] for pair in axes)


def with_settings(config: Config, values: dict[str, str]) -> Config:
    """Return the configuration with other values; measures of another target are reset."""
    if 'target.type' in values:
        config = replace(config, method='auto', target=replace(config.target, radius=0.0, size=()))
    return with_assignments(config, [f'{key}={value}' for key, value in values.items()])


def thinned(stop: Stop, config: Config) -> Stop:
    """Return a stop with a few of its profiles."""
    stop = stop.load(config).trimmed(config)
    return replace(stop, profiles=tuple(evenly(stop.profiles, PROFILES_READ)))
