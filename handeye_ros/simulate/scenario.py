# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The cells that are simulated: the parameters of a recording, and the recordings with a name.

SCENARIOS are good cells, and recordings without an answer; FAULTS are cells with a fault of real
ones, which their name tells and their settings do not state. Metres, radians, seconds.
"""
from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
import math
from typing import Any


@dataclass(frozen=True)
class SensorModel:
    """
    A laser profiler: a fan of light from the origin of the sensor frame, and a camera.

    The field of view is a trapezoid: range (min, max) of z, and |x| <= half_width * z.

    columns, rate: points of a profile, and profiles per second
    sampling: 'fan': columns regular in the angle's tangent; 'x': parallel light, regular in x;
        'fan_x': a fan that the driver resamples, regular in x
    camera: (y, z) of the camera's pinhole, outside the light plane: a step can hide a point from
        it
    max_incidence: the angle of incidence beyond which there is no return
    rim_bias: range error just before max_incidence
    noise: 1 sigma of one range
    resolution: step of the reported numbers, 0: none
    distortion: RMS of a smooth error over the field of view, drawn once
    scale: relative error of the coordinates about the middle of the field
    line_bend: y of the light at both ends of the line (at middle range), of a light plane that is
        bent
    speckle: 1 sigma of an error that is constant during a stop, correlated along the line
    spot: 1 sigma of the width of the light along the line; surfaces below the target's face are
        ground times as bright
    smoothing: columns of the driver's mean filter
    mixed, lost, lost_at_edge, outliers: fractions of points at steps that lie between the levels,
        of lost points, of lost points within a few columns of a step, of gross outliers
    reflections: fraction of the profiles with a false piece of line
    delay: from the measurement to the stamp, which is that of receipt
    thinning: while the robot moves, only every nth profile is recorded
    """

    columns: int = 1280
    rate: float = 30.0
    range: tuple[float, float] = (0.150, 0.200)  # noqa: A003
    half_width: float = 0.14
    sampling: str = 'fan'
    camera: tuple[float, float] = (0.07, 0.0)
    noise: float = 3e-5
    resolution: float = 0.0
    distortion: float = 0.0
    scale: float = 0.0
    line_bend: float = 0.0
    speckle: float = 0.0
    spot: float = 0.0
    ground: float = 1.0
    smoothing: int = 0
    max_incidence: float = 1.2
    rim_bias: float = 3e-4
    mixed: float = 0.5
    lost: float = 0.002
    lost_at_edge: float = 0.1
    outliers: float = 0.005
    reflections: float = 0.0
    delay: float = 0.005
    thinning: int = 1


@dataclass(frozen=True)
class RobotModel:
    """
    A robot that stops; reported pose = true pose + error.

    repeatability: (translation, rotation), 1 sigma of each axis, drawn once per stop
    systematic: (translation, rotation), RMS of the vectors of an error that varies smoothly over
        the workspace
    geometry: 1 sigma of the errors of joints and links (m, and rad of 1 m) of a six-axis arm, 0:
        no arm
    scale: relative error of reported positions
    jitter: 1 sigma of each streamed pose (m and rad)
    rate: poses per second
    dwell, move: duration of a stop and of a motion
    """

    repeatability: tuple[float, float] = (2e-5, math.radians(0.004))
    systematic: tuple[float, float] = (0.0, 0.0)
    geometry: float = 0.0
    scale: float = 0.0
    jitter: float = 1e-6
    rate: float = 100.0
    dwell: float = 1.0
    move: float = 1.2


@dataclass(frozen=True)
class PlateTarget:
    """
    A plate with its corner in the origin, its face z = 0, 0 <= x <= size[0], 0 <= y <= size[1].

    Edge p is y = 0, edge q is x = 0; the face looks along +z.

    table: depth of the table below the face, None: no table
    clutter: height above the face (negative: below) of the top of a block beside each of these
        edges, None: no blocks
    clutter_gap, clutter_width: its distance from the edge, and its width
    edge_angle: between p and q; rendered profiles, unlike direct samples, are always of a square
        plate
    rounding: radius of the edges of the face; only in rendered profiles, as what follows
    bevel: legs of their chamfer
    bow: height of the middle of the face above its corners
    waves: RMS of its waves
    """

    size: tuple[float, float] = (0.20, 0.15)
    thickness: float = 0.010
    table: float | None = 0.025
    clutter: float | None = None
    clutter_gap: float = 0.008
    clutter_width: float = 0.010
    edge_angle: float = math.pi / 2
    rounding: float = 0.0
    bevel: float = 0.0
    bow: float = 0.0
    waves: float = 0.0


@dataclass(frozen=True)
class SphereTarget:
    """
    A ball around the origin on a stem along -z, above or set into a table at z = -table.

    clutter: a block stands beside it.
    """

    radius: float = 0.040
    table: float | None = 0.030
    clutter: bool = True


@dataclass(frozen=True)
class WedgeTarget:
    """
    A block whose edge is the x axis, its faces z = 0 (y > 0) and y = 0 (z < 0).

    concave: the inside of an angle instead, its faces z = 0 (y > 0) and y = 0 (z > 0).
    """

    length: float = 0.15
    width: float = 0.08
    concave: bool = False


@dataclass(frozen=True)
class Sweep:
    """
    A path through all stops without stopping, a knot of a smooth curve at each; seconds.

    exposure: averaging time of one profile
    rotation_lag: delay of the reported rotation
    stamp_jitter, pose_jitter: 1 sigma of the stamps
    gaps: number of gaps in the poses
    resolution: rounding of positions (m), 0: none
    drift: RMS of the vectors of an error (translation, rotation) of the poses that varies smoothly
    """

    knot: float = 1.6
    exposure: float = 0.0
    rotation_lag: float = 0.0
    stamp_jitter: float = 0.0
    pose_jitter: float = 0.0
    gaps: int = 0
    resolution: float = 0.0
    drift: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Scenario:
    """
    All parameters of a recording.

    scene: key of scenes.SCENES
    frame: of the driver: 'standard' (x along the line, z the range), or another of sensor.FRAMES
    no_return: 'nan', 'inf', or 'omit' for points that are left out of the message
    stops: number at edges p and q of the plate; of other targets their sum counts
    motion: key of scenes.MOTIONS
    tilt: largest tilt about each sensor axis
    shuffled: the order of the stops is random
    bumped: number of stops whose reported pose is grossly wrong
    wrong_edges: number of stops at an edge of the plate that is neither p nor q
    empty: there is no target
    wrong_conventions: keys of robot.WRONG_CONVENTIONS, applied in order
    repeats: number of runs of the programme of stops
    lever: smallest and largest distance of the sensor from its mount
    stated: settings that are not the values of the cell, by dotted key
    sweep: the motion without stops; the repeatability is then drawn for each streamed pose, and
        bumped, wrong_conventions, and scale and jitter of the robot have no effect
    """

    name: str = 'plate'
    scene: str = 'plate'
    target: Any = PlateTarget()  # the one of the scene
    sensor: SensorModel = field(default_factory=SensorModel)
    robot: RobotModel = field(default_factory=RobotModel)
    frame: str = 'standard'
    no_return: str = 'nan'
    stops: tuple[int, int] = (9, 9)
    motion: str = 'general'
    tilt: float = math.radians(30)
    shuffled: bool = True
    calibration_type: str = 'eye_in_hand'
    bumped: int = 0
    wrong_edges: int = 0
    empty: bool = False
    wrong_conventions: tuple[str, ...] = ()
    repeats: int = 1
    lever: tuple[float, float] = (0.1, 0.2)
    stated: tuple[tuple[str, Any], ...] = ()
    sweep: Sweep | None = None

    @property
    def profiles_per_stop(self) -> int:
        """Return the number of profiles recorded during a stop."""
        return max(1, int(self.robot.dwell * self.sensor.rate))


def changed(base: Scenario, name: str, **changes: Any) -> Scenario:
    """Return a changed scenario under another name; a dict changes fields of one of its parts."""
    return replace(base, name=name, **{
        key: replace(getattr(base, key), **value) if isinstance(value, dict) else value
        for key, value in changes.items()})


def one_of_each(plate: Scenario, wide: SensorModel) -> tuple[Scenario, ...]:
    """Return a scenario for each target: plate as given, sphere with a wide sensor, and others."""
    one_group = replace(plate, stops=(14, 0))
    return (plate,
            replace(one_group, name='sphere', scene='sphere', target=SphereTarget(), sensor=wide,
                    tilt=math.radians(40)),
            replace(one_group, name='line', scene='line'),
            replace(one_group, name='plane', scene='plane',
                    target=PlateTarget((0.4, 0.3), table=None)),
            replace(one_group, name='wedge', scene='wedge', target=WedgeTarget(),
                    tilt=math.radians(20)))


WIDE_SENSOR = SensorModel(range=(0.14, 0.27), half_width=0.27, max_incidence=1.15)
PLATE, SPHERE, LINE, PLANE, WEDGE = ALL_TARGETS = one_of_each(Scenario(), WIDE_SENSOR)
WRONG_ARM = RobotModel(geometry=3e-4, rate=50.0)
REAL_ROBOT = RobotModel(systematic=(1.5e-4, math.radians(0.02)))

# Recordings that compress well: fewer profiles, numbers in steps of 2^-20 m (1 um).
SMALL_BAG: dict[str, Any] = {'rate': 10.0, 'resolution': 2.0**-20, 'thinning': 2}
SLOW_BAG = SMALL_BAG | {'rate': 5.0}
FEW_POSES = {'rate': 50.0}
COARSE_PLATE = changed(PLATE, 'coarse', sensor=SLOW_BAG | {'columns': 256}, robot=FEW_POSES)


def swept(base: Scenario, name: str, columns: int = 640, rate: float = 50.0,
          poses: float = 250.0, **sensor: Any) -> Scenario:
    """Return a sweep over a target in place of stops, with profiles stamped 20 ms early."""
    return changed(base, name, stops=(10, 10) if base.scene == 'plate' else (20, 0),
                   tilt=min(math.radians(24), base.tilt), sweep=Sweep(), robot={'rate': poses},
                   sensor={'columns': columns, 'rate': rate, 'delay': -0.02, 'rim_bias': 0.0,
                           **sensor})


SCENARIOS: dict[str, Scenario] = {s.name: s for s in (
    *ALL_TARGETS,
    changed(WEDGE, 'groove', target={'concave': True}),
    changed(PLATE, 'plate_5_5', stops=(5, 5)),
    changed(PLATE, 'plate_in_order', shuffled=False),
    # surroundings
    changed(PLATE, 'plate_in_air', target={'table': None}),
    changed(PLATE, 'plate_on_table', target={'table': 0.010}),
    changed(PLATE, 'plate_clutter', target={'clutter': -0.004}),
    # sensors and drivers
    changed(PLATE, 'plate_resampled', sensor={'sampling': 'x', 'resolution': 1e-6}),
    changed(PLATE, 'plate_reflections', sensor={'reflections': 0.3, 'outliers': 0.02}),
    changed(PLATE, 'plate_inf', no_return='inf'),
    changed(PLATE, 'plate_omit', no_return='omit'),
    *(changed(PLATE, f'plate_{frame}', frame=frame)
      for frame in ('z_up', 'x_reversed', 'y_along_line')),
    # robots
    changed(PLATE, 'plate_real_robot', robot=REAL_ROBOT),
    changed(SPHERE, 'sphere_real_robot', robot=REAL_ROBOT),
    changed(PLATE, 'eye_on_base', calibration_type='eye_on_base'),
    # recordings without an answer, or with warnings
    *(changed(PLATE, motion, motion=motion)
      for motion in ('one_orientation', 'one_orientation_per_edge', 'tilt_only', 'yaw_only')),
    changed(PLATE, 'bumped', bumped=1),
    changed(PLATE, 'wrong_edges', wrong_edges=2),
    changed(PLATE, 'no_target', empty=True),
    changed(PLATE, 'nothing_in_sight', empty=True, target={'table': None}),
    changed(PLATE, 'inverted_poses', wrong_conventions=('inverted',)),
    *(changed(PLATE, name, wrong_conventions=(name,))
      for name in ('wxyz', 'millimetres', 'degrees', 'intrinsic')),
    # the robot moves all the time
    *(swept(base, f'{base.name}_sweep') for base in ALL_TARGETS),
    # the recordings in bags/
    swept(PLATE, 'small_plate_sweep', 320, 12.0, 50.0, resolution=2.0**-20),
    changed(PLATE, 'small_plate', sensor=SMALL_BAG, robot=FEW_POSES),
    changed(SPHERE, 'small_sphere', sensor=SMALL_BAG | {'columns': 640}, robot=FEW_POSES),
    changed(LINE, 'small_line', sensor=SLOW_BAG | {'columns': 640}, robot=FEW_POSES),
    changed(PLANE, 'small_plane', sensor=SLOW_BAG | {'columns': 640}, robot=FEW_POSES),
    changed(SPHERE, 'small_arm', robot=replace(WRONG_ARM, rate=20.0), stops=(30, 0),
            sensor=SLOW_BAG | {'thinning': 20, 'columns': 320}),
    changed(COARSE_PLATE, 'small_one_orientation', motion='one_orientation'),
    changed(COARSE_PLATE, 'small_inverted_poses', wrong_conventions=('inverted',)),
)}


MM, UM = 1e-3, 1e-6
QUICK_RECORDING: dict[str, Any] = {'rate': 6.0, 'delay': 0.0, 'thinning': 10**6}
BASELINE = Scenario('baseline', sensor=SensorModel(**QUICK_RECORDING),
                    robot=RobotModel(rate=20.0, dwell=0.85, move=0.5))
BASELINES = tuple(changed(base, f'{base.scene}, baseline')
                  for base in one_of_each(BASELINE, replace(WIDE_SENSOR, **QUICK_RECORDING)))
BALL = BASELINES[1]
# x from 0 to 140 mm, range from -25 to +25 mm counted upwards
OFF_CENTRE: dict[str, Any] = {'range': (0.25, 0.30), 'half_width': 0.2545, 'sampling': 'fan_x',
                              'camera': (0.12, 0.0)}
STATED_TOO_SMALL = tuple(zip(('noise.robot_translation', 'noise.robot_rotation'), (
    sigma / 1.3 for sigma in BASELINE.robot.repeatability), strict=True))


def smooth(error: float) -> dict[str, tuple[float, float]]:
    """Return a smooth error (m) as fields of RobotModel; its rotation is that at 0.3 m (rad)."""
    return {'systematic': (error, error / 0.3)}


def each(bases: Iterable[Scenario], fault: str, **changes: Any) -> Iterator[Scenario]:
    """Yield scenarios with a fault, named by their scene and the fault."""
    return (changed(base, f'{base.scene}, {fault}', **changes) for base in bases)


FAULTS: dict[str, Scenario] = {s.name: s for s in (
    *BASELINES,
    # targets
    *(changed(BASELINE, f'rounded {r} mm', target={'rounding': r * MM}) for r in (0.3, 0.5, 1.0)),
    *(changed(BASELINE, f'bevelled {legs} mm', target={'bevel': legs * MM})
      for legs in (0.2, 0.3, 0.5)),
    changed(BASELINE, 'thin, 2 mm', target={'thickness': 2 * MM}),
    changed(BASELINE, 'thin, 2 mm, in air', target={'thickness': 2 * MM, 'table': None}),
    *(changed(BASELINE, f'bowed {bow} mm', target={'bow': bow * MM}) for bow in (0.05, 0.1)),
    changed(BASELINE, 'wavy 10 um', target={'waves': 10 * UM}),
    *(changed(BASELINE, f'neighbour {word}, 3 mm', target={
        'clutter': height * MM, 'clutter_gap': 3 * MM, 'clutter_width': 0.06})
      for word, height in (('lower', -3), ('higher', 3))),
    *(changed(BASELINE, f'neighbour 1 mm higher, {gap} mm', target={
        'clutter': 1 * MM, 'clutter_gap': gap * MM}) for gap in (8, 16)),
    # sensors
    changed(BASELINE, 'smoothed over 9 columns', sensor={'smoothing': 9, 'outliers': 0.001}),
    *(changed(BASELINE, f'blurred, {word} ground', sensor={'spot': 0.2 * MM, 'ground': ground})
      for word, ground in (('bright', 4.0), ('dark', 0.25))),
    *(changed(BASELINE, f'distorted {size} mm', sensor={'distortion': size * MM})
      for size in (0.01, 0.02, 0.05)),
    *each(BASELINES[1:], 'distorted 0.02 mm', sensor={'distortion': 0.02 * MM}),
    changed(BASELINE, 'scale 1e-3', sensor={'scale': 1e-3}),
    *each(BASELINES, 'line bent by 0.15 mm', sensor={'line_bend': 0.15 * MM}),
    *each(BASELINES[:2], 'frozen speckle 20 um', sensor={'noise': 4 * UM, 'speckle': 20 * UM},
          stated=(('noise.sensor', 20 * UM),)),
    *each(BASELINES, 'wide off-centre', sensor=OFF_CENTRE, lever=(0.5, 2.0),
          frame='off_centre'),
    # robots
    *(changed(BASELINE, f'joints and links {error} mm', robot={'geometry': error * MM})
      for error in (0.1, 0.3)),
    *each(BASELINES, 'joints and links 1 mm', robot={'geometry': 1 * MM}),
    *(changed(BASELINE, f'smooth {error} mm', robot=smooth(error * MM))
      for error in (0.1, 0.2, 0.3, 1.0)),
    *each(BASELINES[1:], 'smooth 0.2 mm', robot=smooth(0.2 * MM)),
    changed(BASELINE, 'repeatability 1.3 times stated', stated=STATED_TOO_SMALL),
    *(changed(BASELINE, f'6 poses x 4{word}', robot=error, stops=(3, 3), repeats=4)
      for word, error in (('', {}), (', smooth 0.15 mm', smooth(0.15 * MM)),
                          (', joints 0.1 mm', {'geometry': 0.1 * MM}))),
    *(changed(BASELINE, f'robot scale {scale} %', robot={'scale': scale / 100})
      for scale in (0.05, 0.1, 0.2)),
    # stated sizes of the target
    *(changed(BALL, f'radius {wrong} mm off', stated=(
        ('target.radius', SphereTarget().radius - wrong * MM),)) for wrong in (0.2, 0.3)),
    changed(BASELINE, 'size 0.3 mm off', wrong_edges=6, stated=(
        ('target.size', [PlateTarget().size[0] + 0.3 * MM, PlateTarget().size[1]]),)),
    # few stops
    changed(BASELINE, '3 + 3, one bad', stops=(3, 3), bumped=1),
    changed(BASELINE, '4 + 3, two bad', stops=(4, 3), bumped=2),
    changed(BASELINE, '4 + 4, one bad', stops=(4, 4), bumped=1),
)}
"""The cells of bench/physics.py: BASELINES without a fault, then each with one."""
