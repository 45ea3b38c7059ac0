"""Samples made directly, without profiles: exact Gaussian noise, thousands in seconds."""
from __future__ import annotations

from dataclasses import replace

from handeye_ros.data import Sample
from handeye_ros.simulate import cell as cells
from handeye_ros.simulate.scenario import Scenario, Truth
from handeye_ros.simulate.scenes import anywhere, SCENES
import numpy as np


def simulate_samples(
        scenario: Scenario, rng: np.random.Generator) -> tuple[tuple[Sample, ...], Truth]:
    """
    Return the samples of a recording and what is true.

    Each feature has exactly the noise that it states (white sensor noise of all profiles of a
    stop, averaged), each pose the robot's error. Standard sensor frame; convention errors are
    not applied.
    """
    scenario = replace(scenario, layout=replace(scenario.layout, frame='standard'))
    scene = SCENES[scenario.scene]
    stops = scene.stops(scenario, rng)
    stops = stops.ordered(cells.visit_order(scenario, len(stops.labels), rng))
    cell = cells.draw(scenario, stops, anywhere(scenario), rng)
    spacing = int((scenario.robot.dwell + scenario.robot.move) * 1e9)
    starts = np.arange(len(stops.labels)) * spacing
    spans = np.stack([starts, starts + int(scenario.robot.dwell * 1e9)], axis=1)
    truth = cells.truth(scenario, cell, stops, spans)
    features = scene.features(scenario, stops, rng)
    samples = tuple(Sample(s.start, s.T_base_flange_reported, f, scenario.profiles_per_stop)
                    for s, f in zip(truth.stations, features, strict=True))
    return samples, truth
