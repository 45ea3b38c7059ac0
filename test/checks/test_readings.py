"""A wrong reading of the profiles, or of lengths, is named and not answered."""
from dataclasses import replace

from handeye_ros import config as configs
from handeye_ros import pipeline
from handeye_ros.checks.errors import RangeSignError, ScaleError
from handeye_ros.config import Config
from handeye_ros.simulate import SCENARIOS, settings, simulate, simulate_samples
import numpy as np
import pytest


@pytest.mark.parametrize('name, seed', [('plate', 0), ('plate_z_up', 1)])
def test_a_range_counted_the_wrong_way_is_named(name: str, seed: int) -> None:
    scenario = replace(SCENARIOS[name], sensor=replace(SCENARIOS[name].sensor, rate=10.0))
    made = simulate(scenario, np.random.default_rng(seed))
    right = configs.with_values(Config(), settings(scenario), 'the test')
    with pytest.raises(RangeSignError, match=f'range_sign {right.profile.range_sign} '):
        pipeline.calibrate(made.profiles, made.poses, configs.flipped_range(right))


@pytest.mark.parametrize('target', ['plate', 'sphere', 'line', 'plane', 'wedge'])
@pytest.mark.parametrize('scale', [0.98, 1.02])
def test_lengths_that_differ_are_named(target: str, scale: float) -> None:
    scenario = SCENARIOS[target]
    samples, _ = simulate_samples(scenario, np.random.default_rng(3))
    stretched = []
    for sample in samples:
        T = sample.T_base_flange.copy()
        T[:3, 3] *= scale
        stretched.append(replace(sample, T_base_flange=T))
    config = configs.with_values(Config(), settings(scenario), 'the test')
    with pytest.raises(ScaleError) as refusal:
        pipeline.solve(stretched, (), config, 'laser')
    told = float(str(refusal.value).split('differ by ')[1].split(' ')[0])
    assert told == pytest.approx(2.0, abs=0.3)
