"""A recording that is read with a wrong setting names the setting and its right value."""
from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

from handeye_ros import pipeline, se3
from handeye_ros.config import Config, with_values
from handeye_ros.diagnosis.settings import require_settings, WrongSettingError
from handeye_ros.errors import DataError
from handeye_ros.simulate import FAULTS, settings, simulate, Simulated
import numpy as np
import pytest


@lru_cache
def made(name: str) -> Simulated:
    return simulate(FAULTS[name], np.random.default_rng(0))


def solved(name: str, **values: object) -> object:
    config = with_values(Config(), settings(FAULTS[name]) | {
        key.replace('__', '.'): value for key, value in values.items()}, 'the test')
    return pipeline.calibrate(made(name).profiles, made(name).poses, config)


@pytest.mark.parametrize(('name', 'wrong', 'right'), [
    ('sphere', 'plate', 'sphere'), ('baseline', 'sphere', 'plate'), ('baseline', 'line', 'plate'),
    ('wedge', 'sphere', 'wedge')])
def test_another_target_is_named(name: str, wrong: str, right: str) -> None:
    with pytest.raises(WrongSettingError, match=f'set target.type to {right}$'):
        solved(name, target__type=wrong)


def test_two_wrong_settings_are_named_together() -> None:
    with pytest.raises(WrongSettingError,
                       match='set target.type to plate and profile.range_sign to 1$'):
        solved('baseline', target__type='wedge', profile__range_sign=-1)


def test_what_no_setting_mends_is_not_blamed_on_one() -> None:
    poses = [replace(p, quaternion=se3.quaternion(se3.from_quaternion(
        np.zeros((1, 3)), np.random.default_rng(k // 20).normal(size=(1, 4))))[0])
        for k, p in enumerate(made('baseline').poses)]
    config = with_values(Config(), settings(FAULTS['baseline']), 'the test')
    with pytest.raises(DataError) as caught:
        pipeline.calibrate(made('baseline').profiles, poses, config)
    assert not isinstance(caught.value, WrongSettingError)


@pytest.mark.parametrize('name', ['baseline', 'line'])
def test_right_settings_are_not_blamed(name: str) -> None:
    config = with_values(Config(), settings(FAULTS[name]), 'the test')
    require_settings(pipeline.gather(made(name).profiles, made(name).poses, config), config)
