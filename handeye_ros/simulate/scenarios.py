"""The ready-made recordings, by name."""
from __future__ import annotations

from dataclasses import replace
import math
from typing import Any

from handeye_ros.simulate.conventions import CONVENTION_ERRORS
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
    """Return a scenario of each target: plate as given, sphere, line, plane and wedge."""
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
           poses: float = 250.0, **more: Any) -> Scenario:
    """Return a sweep over a target in place of stops, its profiles stamped 20 ms early."""
    sensor = replace(base.sensor, columns=columns, rate=rate, delay=-0.02, rim_bias=0.0, **more)
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
    # what cannot carry an answer, or only in part
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
