"""
Cells with the faults of real ones, by name; few profiles, quick to render.

What a name says is all that is wrong; the settings do not know of it.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from handeye_ros.simulate.scenario import (
    Layout,
    PlateTarget,
    RobotModel,
    Scenario,
    SensorModel,
    SphereTarget,
)
from handeye_ros.simulate.scenarios import bases, WIDE

QUICK: dict[str, Any] = {'rate': 6.0, 'delay': 0.0, 'thinning': 10**6}
ROBOT = RobotModel(rate=20.0, dwell=0.85, move=0.5)
PLATE = Scenario('baseline', sensor=SensorModel(**QUICK), robot=ROBOT)
_, SPHERE, LINE, PLANE, WEDGE = BASELINES = bases(PLATE, replace(WIDE, **QUICK))
# x from 0 to 140 mm, range from -25 to +25 mm counted upwards
OFF_CENTRE = SensorModel(**QUICK, range=(0.25, 0.30), half_width=0.2545, sampling='fan_x',
                         camera=(0.12, 0.0))
MM, UM = 1e-3, 1e-6


def _target(name: str, **values: Any) -> Scenario:
    return replace(PLATE, name=name, target=replace(PLATE.target, **values))


def _sensor(name: str, base: Scenario = PLATE, stated: Any = (), **values: Any) -> Scenario:
    return replace(base, name=name, sensor=replace(base.sensor, **values), stated=tuple(stated))


def _robot(name: str, base: Scenario = PLATE, stated: Any = (), **values: Any) -> Scenario:
    return replace(base, name=name, robot=replace(base.robot, **values), stated=tuple(stated))


def _off_centre(name: str, base: Scenario) -> Scenario:
    sensor = OFF_CENTRE if base.scene != 'sphere' else replace(OFF_CENTRE, max_incidence=1.15)
    return replace(base, name=name, sensor=sensor, layout=Layout('off_centre'), lever=(0.5, 2.0))


def _targets() -> Iterator[Scenario]:
    for radius in (0.3, 0.5, 1.0):
        yield _target(f'rounded {radius} mm', rounding=radius * MM)
    yield replace(_target('rounded 0.5 mm, 50 stations', rounding=0.5 * MM), stations=(25, 25))
    for legs in (0.2, 0.3, 0.5):
        yield _target(f'bevelled {legs} mm', bevel=legs * MM)
    yield _target('thin, 2 mm', thickness=2 * MM)
    yield _target('thin, 2 mm, in air', thickness=2 * MM, table=None)
    for bow in (0.05, 0.1):
        yield _target(f'bowed {bow} mm', bow=bow * MM)
    yield _target('wavy 10 um', waves=10 * UM)
    for what, height in (('lower', -3 * MM), ('higher', 3 * MM)):
        yield _target(f'neighbour {what}, 3 mm', clutter=height, clutter_gap=3 * MM,
                      clutter_width=0.06)
    for gap in (8, 16):
        yield _target(f'neighbour 1 mm higher, {gap} mm', clutter=1 * MM, clutter_gap=gap * MM)


def _sensors() -> Iterator[Scenario]:
    yield _sensor('smoothed over 9 columns', smoothing=9, outliers=0.001)
    for what, ground in (('bright', 4.0), ('dark', 0.25)):
        yield _sensor(f'blurred, {what} ground', spot=0.2 * MM, ground=ground)
    for size in (0.01, 0.02, 0.05):
        yield _sensor(f'distorted {size} mm', distortion=size * MM)
    for base in BASELINES[1:]:
        yield _sensor(f'{base.scene}, distorted 0.02 mm', base, distortion=0.02 * MM)
    yield _sensor('scale 1e-3', scale=1e-3)
    yield _sensor('shear 1e-3', shear=1e-3)
    yield _sensor('diverging fan, resampled in x', sampling='fan_x')
    stated = {'noise.sensor': 20 * UM}.items()
    for base in (PLATE, SPHERE):
        yield _sensor(f'{base.scene}, frozen speckle 20 um', base, stated, noise=4 * UM,
                      speckle=20 * UM)
    for base in BASELINES:
        yield _off_centre(f'{base.scene}, wide off-centre', base)


def _robots() -> Iterator[Scenario]:
    for error in (0.1, 0.3):
        yield _robot(f'joints and links {error} mm', geometry=error * MM)
    for base in BASELINES:
        yield _robot(f'{base.scene}, joints and links 1 mm', base, geometry=1 * MM)
    for error in (0.1, 0.2, 0.3, 1.0):  # radians: what the error is at 0.3 m
        yield _robot(f'smooth {error} mm', systematic=(error * MM, error * MM / 0.3))
    smooth: dict[str, Any] = {'systematic': (0.2 * MM, 0.2 * MM / 0.3)}
    yield replace(_robot('smooth 0.2 mm, 5 + 5', **smooth), stations=(5, 5))
    for base in BASELINES[1:]:
        yield _robot(f'{base.scene}, smooth 0.2 mm', base, **smooth)
    stated = {'noise.robot_translation': ROBOT.repeatability[0] / 1.3,
              'noise.robot_rotation': ROBOT.repeatability[1] / 1.3}.items()
    yield _robot('repeatability 1.3 times stated', PLATE, stated)
    errors: dict[str, dict[str, Any]] = {
        '': {}, ', smooth 0.15 mm': {'systematic': (0.15 * MM, 0.15 * MM / 0.3)},
        ', joints 0.1 mm': {'geometry': 0.1 * MM}}
    for what, values in errors.items():
        yield replace(_robot(f'6 poses x 4{what}', **values), stations=(3, 3), repeats=4)
    for scale in (0.05, 0.1, 0.2):
        yield _robot(f'robot scale {scale} %', scale=scale / 100)


def _tolerances() -> Iterator[Scenario]:
    for wrong in (0.2, 0.3):
        stated = SphereTarget().radius - wrong * MM
        yield replace(SPHERE, name=f'radius {wrong} mm off', stated=(('target.radius', stated),))
    length, width = PlateTarget().size
    yield replace(PLATE, name='size 0.3 mm off', wrong_edges=6,
                  stated=(('target.size', [length + 0.3 * MM, width]),))


def _few() -> Iterator[Scenario]:
    yield replace(PLANE, name='plane, 5 stations', stations=(5, 0))
    yield replace(PLATE, name='3 + 3, one bad', stations=(3, 3), bumped=1)
    yield replace(PLATE, name='4 + 3, two bad', stations=(4, 3), bumped=2)
    yield replace(PLATE, name='4 + 4, one bad', stations=(4, 4), bumped=1)


FAULTS: dict[str, Scenario] = {s.name: s for s in (
    *BASELINES, *_targets(), *_sensors(), *_robots(), *_tolerances(), *_few())}
"""The cells of bench/physics.py; the first four have no fault."""
