"""The targets that can be simulated: one entry each."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from handeye_ros.data import Feature
from handeye_ros.simulate import plate, sphere, wedge
from handeye_ros.simulate.scenario import Scenario
from handeye_ros.simulate.solids import Solid
from handeye_ros.simulate.stations import Stops
import numpy as np

MANY = 100  # stops at each edge


@dataclass(frozen=True)
class Scene:
    """
    What the simulator must know of a target.

    stops: draws the sensor poses; solids: what stands there, in the target frame; features:
    what each stop would give, with its noise.
    """

    stops: Callable[[Scenario, np.random.Generator], Stops]
    solids: Callable[[Scenario], tuple[Solid, ...]]
    features: Callable[[Scenario, Stops, np.random.Generator], list[tuple[Feature, ...]]]


SCENES = {
    'plate': Scene(plate.stops, plate.solids, plate.features),
    'line': Scene(plate.stops, plate.solids, plate.features),
    'plane': Scene(plate.plane_stops, plate.solids, plate.plane_features),
    'sphere': Scene(sphere.stops, sphere.solids, sphere.features),
    'wedge': Scene(wedge.stops, wedge.solids, wedge.features),
}


def anywhere(scenario: Scenario) -> Stops:
    """Return many stops such as the scenario's own."""
    first, second = scenario.stations
    many = replace(scenario, stations=(MANY * (first > 0), MANY * (second > 0)), wrong_edges=0)
    return SCENES[scenario.scene].stops(many, np.random.default_rng(0))
