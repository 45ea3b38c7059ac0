"""Profiles tell by themselves, before any solve, that their range is counted the wrong way."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from cells import recorded
from handeye_ros import pipeline
from handeye_ros.checks.alternatives import range_sign_evidence, RangeSignEvidence
from handeye_ros.checks.errors import RangeSignError
from handeye_ros.config import Config, flipped_range, with_values
from handeye_ros.data import Array, Feature, Reject, Sample
from handeye_ros.errors import FeatureError
from handeye_ros.profiles.faces import face_features
from handeye_ros.simulate import SCENARIOS, settings, simulate
import numpy as np
from profiles import drawn, face, gap_up_to, roof, step_up_to
import pytest

RIGHT = Config()
WRONG = flipped_range(RIGHT)


def station(points: Array, config: Config, number: int = 0) -> Sample | Reject:
    """Return what a session makes of a stop with one profile."""
    def shown(config: Config) -> tuple[Feature, ...]:
        try:
            return face_features(points, config)
        except FeatureError:
            return ()
    features, flipped = shown(config), shown(flipped_range(config))
    return (Sample(number, np.eye(4), features, flipped=flipped) if features
            else Reject(number, 'none', flipped))


def stations(shape: Callable[..., Callable[[Array], Array]], config: Config, count: int = 12
             ) -> list[Sample | Reject]:
    """Return what a session makes of a profile each of so many stops."""
    return [station(drawn(shape(-0.004 + 0.001 * seed), seed), config, seed)
            for seed in range(count)]


def test_corners_read_the_wrong_way_speak_against_it() -> None:
    evidence = range_sign_evidence(stations(roof, WRONG))
    assert (evidence.as_set, evidence.flipped, evidence.total) == (0, 12, 12)
    assert evidence.against
    assert evidence.hint(WRONG).startswith(
        'with profile.range_sign -1, 0 of 12 stations show an edge; counted the other way 12 of '
        '12 do: set profile.range_sign to 1')


@pytest.mark.parametrize('shape', [roof, step_up_to, gap_up_to])
def test_edges_read_the_right_way_do_not(shape: Callable[..., Callable[[Array], Array]]) -> None:
    evidence = range_sign_evidence(stations(shape, RIGHT))
    assert evidence.as_set == evidence.total == 12
    assert not evidence.against and not evidence.hint(RIGHT)


def test_few_stations_and_none_say_nothing() -> None:
    assert not range_sign_evidence([]).against
    assert not range_sign_evidence(stations(roof, WRONG, 5)).against
    assert not range_sign_evidence(Reject(k, 'dark') for k in range(30)).against


@pytest.mark.parametrize('evidence, against', [
    (RangeSignEvidence(4, 26, 4, 26), True), (RangeSignEvidence(14, 26, 14, 26), False),
    (RangeSignEvidence(4, 15, 4, 26), False), (RangeSignEvidence(6, 24, 2, 28), False)])
def test_the_sign_must_be_the_one_thing_that_parts_them(evidence: RangeSignEvidence,
                                                        against: bool) -> None:
    assert evidence.against is against


@pytest.mark.parametrize('shape, config, as_set, flipped', [
    (roof(0.003), RIGHT, 1, 0), (roof(0.003), WRONG, 0, 1), (face, RIGHT, 0, 0)])
def test_one_profile_says_which_way_it_shows_an_edge(
        shape: Callable[[Array], Array], config: Config, as_set: int, flipped: int) -> None:
    evidence = range_sign_evidence([station(drawn(shape), config)])
    assert (evidence.as_set, evidence.flipped) == (as_set, flipped)


def test_the_rejects_of_a_recording_carry_what_the_other_way_shows() -> None:
    made = recorded('plate_on_table', 0, columns=640)
    right = pipeline.gather(made.profiles, made.poses, made.config)
    evidence = range_sign_evidence([*right.samples, *right.rejects])
    assert evidence.as_set > 0.8 * evidence.total and not evidence.against
    wrong = pipeline.gather(made.profiles, made.poses, flipped_range(made.config))
    both = range_sign_evidence([*wrong.samples, *wrong.rejects])
    assert (both.as_set, both.flipped) == (evidence.flipped, evidence.as_set)


@pytest.mark.thorough
@pytest.mark.parametrize('seed', range(3))
def test_the_foot_of_a_plate_is_not_taken_for_its_edge(seed: int) -> None:
    made = recorded('plate_on_table', seed, columns=640)
    with pytest.raises(RangeSignError, match='with profile.range_sign 1 the residual falls'):
        pipeline.calibrate(made.profiles, made.poses, flipped_range(made.config))


@pytest.mark.parametrize('name, seed', [('plate', 0), ('plate_z_up', 1)])
def test_a_range_counted_the_wrong_way_is_named(name: str, seed: int) -> None:
    scenario = replace(SCENARIOS[name], sensor=replace(SCENARIOS[name].sensor, rate=10.0))
    made = simulate(scenario, np.random.default_rng(seed))
    right = with_values(Config(), settings(scenario), 'the test')
    with pytest.raises(RangeSignError, match=f'range_sign {right.profile.range_sign} '):
        pipeline.calibrate(made.profiles, made.poses, flipped_range(right))
