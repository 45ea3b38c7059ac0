# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The predefined recordings, and cells with the faults of real ones, by name.

A cell with a fault has only the fault in its name; the settings do not state it. Cells with faults
have few profiles, for fast rendering.
"""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
import math
from typing import Any

from handeye_ros.simulate.arm import CONVENTION_ERRORS
from handeye_ros.simulate.scenario import (
    Layout,
    PlateTarget,
    RobotModel,
    Scenario,
    SensorModel,
    SphereTarget,
    Sweep,
    WedgeTarget,
)

PLATE = Scenario()
WIDE = SensorModel(range=(0.14, 0.27), half_width=0.27, max_incidence=1.15)


def bases(plate: Scenario, wide: SensorModel) -> tuple[Scenario, ...]:
    """Return a scenario for each target: plate as given, sphere, line, plane and wedge."""
    one_group = replace(plate, stations=(14, 0))
    return (plate,
            replace(one_group, name='sphere', scene='sphere', target=SphereTarget(), sensor=wide,
                    tilt=math.radians(40)),
            replace(one_group, name='line', scene='line'),
            replace(one_group, name='plane', scene='plane',
                    target=PlateTarget((0.4, 0.3), table=None)),
            replace(one_group, name='wedge', scene='wedge', target=WedgeTarget(),
                    tilt=math.radians(20)))


_, SPHERE, LINE, PLANE, WEDGE = BASES = bases(PLATE, WIDE)
ARM = RobotModel(geometry=3e-4, rate=50.0)
REAL_ROBOT = RobotModel(systematic=(1.5e-4, math.radians(0.02)))


def _sensor(**values: Any) -> SensorModel:
    return replace(PLATE.sensor, **values)


# Recordings that compress well: fewer profiles, numbers in steps of 2^-20 m (1 um).
SMALL: dict[str, Any] = {'rate': 10.0, 'resolution': 2.0**-20, 'thinning': 2}
SLOW = SMALL | {'rate': 5.0}
SMALL_PLATE = replace(PLATE, name='small_plate', sensor=_sensor(**SMALL),
                      robot=replace(PLATE.robot, rate=50.0))
SMALL_LINE, SMALL_PLANE = (
    replace(scenario, name=f'small_{scenario.name}', robot=SMALL_PLATE.robot,
            sensor=_sensor(**SLOW, columns=640)) for scenario in (LINE, PLANE))
COARSE_PLATE = replace(SMALL_PLATE, sensor=_sensor(**SLOW, columns=256))
SMALL_SPHERE = replace(SPHERE, name='small_sphere', robot=SMALL_PLATE.robot,
                       sensor=replace(WIDE, **SMALL, columns=640))


def _swept(base: Scenario, name: str, columns: int = 640, rate: float = 50.0,
           poses: float = 250.0, **sensor_values: Any) -> Scenario:
    """Return a sweep over a target in place of stops, with profiles stamped 20 ms early."""
    sensor = replace(base.sensor, columns=columns, rate=rate, delay=-0.02, rim_bias=0.0,
                     **sensor_values)
    return replace(base, name=name, stations=(10, 10) if base.scene == 'plate' else (20, 0),
                   tilt=min(math.radians(24), base.tilt), sensor=sensor, sweep=Sweep(),
                   robot=replace(base.robot, rate=poses))


SCENARIOS: dict[str, Scenario] = {s.name: s for s in (
    *BASES,
    replace(WEDGE, name='groove', target=WedgeTarget(concave=True)),
    replace(PLATE, name='plate_5_5', stations=(5, 5)),
    replace(PLATE, name='plate_in_order', shuffled=False),
    # surroundings
    replace(PLATE, name='plate_in_air', target=PlateTarget(table=None)),
    replace(PLATE, name='plate_on_table', target=PlateTarget(table=0.010)),
    replace(PLATE, name='plate_clutter', target=PlateTarget(clutter=-0.004)),
    replace(PLATE, name='plate_clutter_high', target=PlateTarget(clutter=0.002)),
    # sensors and drivers
    replace(PLATE, name='plate_resampled', sensor=_sensor(sampling='x', resolution=1e-6)),
    replace(PLATE, name='plate_reflections', sensor=_sensor(reflections=0.3, outliers=0.02)),
    replace(PLATE, name='plate_inf', layout=Layout(no_return='inf')),
    replace(PLATE, name='plate_omit', layout=Layout(no_return='omit')),
    replace(PLATE, name='plate_z_up', layout=Layout('z_up')),
    replace(PLATE, name='plate_x_reversed', layout=Layout('x_reversed')),
    replace(PLATE, name='plate_y_along_line', layout=Layout('y_along_line')),
    # robots
    replace(PLATE, name='plate_real_robot', robot=REAL_ROBOT),
    replace(SPHERE, name='sphere_real_robot', robot=REAL_ROBOT),
    replace(PLATE, name='eye_on_base', calibration_type='eye_on_base'),
    replace(SPHERE, name='sphere_on_flange', calibration_type='eye_on_base'),
    # arms whose joint values are recorded
    replace(PLATE, name='arm_plate', robot=ARM, stations=(20, 20), tilt=math.radians(40)),
    replace(SPHERE, name='arm_sphere', robot=ARM, stations=(40, 0)),
    # recordings without an answer, or with warnings
    replace(PLATE, name='one_orientation', motion='one_orientation'),
    replace(PLATE, name='one_orientation_per_edge', motion='one_orientation_per_edge'),
    replace(PLATE, name='tilt_only', motion='tilt_only'),
    replace(PLATE, name='yaw_only', motion='yaw_only'),
    replace(PLATE, name='bumped', bumped=1),
    replace(PLATE, name='wrong_edges', wrong_edges=2),
    replace(PLATE, name='no_target', empty=True),
    replace(PLATE, name='nothing_in_sight', empty=True, target=PlateTarget(table=None)),
    replace(PLATE, name='inverted_poses', convention_errors=('inverted',)),
    *(replace(PLATE, name=name, convention_errors=(name,)) for name in CONVENTION_ERRORS
      if name != 'inverted'),
    # the robot moves all the time
    *(_swept(base, f'{base.name}_sweep') for base in BASES),
    # the recordings in bags/
    _swept(PLATE, 'small_plate_sweep', 320, 12.0, 50.0, resolution=2.0**-20),
    SMALL_PLATE,
    SMALL_SPHERE,
    SMALL_LINE,
    SMALL_PLANE,
    replace(SMALL_SPHERE, name='small_arm', robot=replace(ARM, rate=20.0), stations=(30, 0),
            sensor=replace(WIDE, **SMALL | {'rate': 5.0, 'thinning': 20}, columns=320)),
    replace(COARSE_PLATE, name='small_one_orientation', motion='one_orientation'),
    replace(COARSE_PLATE, name='small_inverted_poses', convention_errors=('inverted',)),
)}


QUICK: dict[str, Any] = {'rate': 6.0, 'delay': 0.0, 'thinning': 10**6}
ROBOT = RobotModel(rate=20.0, dwell=0.85, move=0.5)
BASELINE = Scenario('baseline', sensor=SensorModel(**QUICK), robot=ROBOT)
BASELINES = bases(BASELINE, replace(WIDE, **QUICK))
# x from 0 to 140 mm, range from -25 to +25 mm counted upwards
OFF_CENTRE = SensorModel(**QUICK, range=(0.25, 0.30), half_width=0.2545, sampling='fan_x',
                         camera=(0.12, 0.0))
MM, UM = 1e-3, 1e-6


def _target(name: str, **values: Any) -> Scenario:
    return replace(BASELINE, name=name, target=replace(BASELINE.target, **values))


def _with_sensor(name: str, base: Scenario = BASELINE, stated: Any = (), **values: Any
                 ) -> Scenario:
    return replace(base, name=name, sensor=replace(base.sensor, **values), stated=tuple(stated))


def _robot(name: str, base: Scenario = BASELINE, stated: Any = (), **values: Any) -> Scenario:
    return replace(base, name=name, robot=replace(base.robot, **values), stated=tuple(stated))


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
    for word, height in (('lower', -3 * MM), ('higher', 3 * MM)):
        yield _target(f'neighbour {word}, 3 mm', clutter=height, clutter_gap=3 * MM,
                      clutter_width=0.06)
    for gap in (8, 16):
        yield _target(f'neighbour 1 mm higher, {gap} mm', clutter=1 * MM, clutter_gap=gap * MM)


def _sensors() -> Iterator[Scenario]:
    yield _with_sensor('smoothed over 9 columns', smoothing=9, outliers=0.001)
    for word, ground in (('bright', 4.0), ('dark', 0.25)):
        yield _with_sensor(f'blurred, {word} ground', spot=0.2 * MM, ground=ground)
    for size in (0.01, 0.02, 0.05):
        yield _with_sensor(f'distorted {size} mm', distortion=size * MM)
    for base in BASELINES[1:]:
        yield _with_sensor(f'{base.scene}, distorted 0.02 mm', base, distortion=0.02 * MM)
    yield _with_sensor('scale 1e-3', scale=1e-3)
    yield _with_sensor('shear 1e-3', shear=1e-3)
    for base in BASELINES:
        yield _with_sensor(f'{base.scene}, line bent by 0.15 mm', base, line_bend=0.15 * MM)
    yield _with_sensor('diverging fan, resampled in x', sampling='fan_x')
    stated = {'noise.sensor': 20 * UM}.items()
    for base in BASELINES[:2]:
        yield _with_sensor(f'{base.scene}, frozen speckle 20 um', base, stated, noise=4 * UM,
                           speckle=20 * UM)
    for base in BASELINES:
        sensor = OFF_CENTRE if base.scene != 'sphere' else replace(OFF_CENTRE, max_incidence=1.15)
        yield replace(base, name=f'{base.scene}, wide off-centre', sensor=sensor,
                      layout=Layout('off_centre'), lever=(0.5, 2.0))


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
    yield _robot('repeatability 1.3 times stated', BASELINE, stated)
    errors: dict[str, dict[str, Any]] = {
        '': {}, ', smooth 0.15 mm': {'systematic': (0.15 * MM, 0.15 * MM / 0.3)},
        ', joints 0.1 mm': {'geometry': 0.1 * MM}}
    for word, values in errors.items():
        yield replace(_robot(f'6 poses x 4{word}', **values), stations=(3, 3), repeats=4)
    for scale in (0.05, 0.1, 0.2):
        yield _robot(f'robot scale {scale} %', scale=scale / 100)


def _tolerances() -> Iterator[Scenario]:
    for wrong in (0.2, 0.3):
        stated = SphereTarget().radius - wrong * MM
        yield replace(BASELINES[1], name=f'radius {wrong} mm off',
                      stated=(('target.radius', stated),))
    length, width = PlateTarget().size
    yield replace(BASELINE, name='size 0.3 mm off', wrong_edges=6,
                  stated=(('target.size', [length + 0.3 * MM, width]),))


def _few() -> Iterator[Scenario]:
    yield replace(BASELINES[3], name='plane, 5 stations', stations=(5, 0))
    yield replace(BASELINE, name='3 + 3, one bad', stations=(3, 3), bumped=1)
    yield replace(BASELINE, name='4 + 3, two bad', stations=(4, 3), bumped=2)
    yield replace(BASELINE, name='4 + 4, one bad', stations=(4, 4), bumped=1)


FAULTS: dict[str, Scenario] = {s.name: s for s in (
    *BASELINES, *_targets(), *_sensors(), *_robots(), *_tolerances(), *_few())}
"""The cells of bench/physics.py; the first five have no fault."""
