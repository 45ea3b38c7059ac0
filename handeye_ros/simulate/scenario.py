# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The parameters of a simulated recording; metres, radians, seconds."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass
import math
import re
from typing import Any


@dataclass(frozen=True)
class SensorModel:
    """
    A laser profiler: a fan of light from the origin of the sensor frame, and a camera.

    The field of view is a trapezoid: range (min, max) of z, and |x| <= half_width * z.
    sampling: 'fan': columns regular in the angle's tangent; 'x': parallel light, regular in x;
    'fan_x': a fan that the driver resamples, regular in x. camera: (y, z) of the camera's pinhole,
    outside the light plane: a step can hide a point from it. max_incidence: beyond it there is no
    return; rim_bias: range error just before it.
    noise: 1 sigma of one range; resolution: step of the numbers, 0: none; distortion: RMS of a
    smooth error over the field of view, drawn once; scale, shear: relative errors of the
    coordinates about the middle of the field, and of x by the range. line_bend: y of the light at
    both ends of the line (at middle range), of a light plane that is bent.
    speckle: 1 sigma of an error that is constant during a stop, correlated over speckle_columns.
    spot: 1 sigma of the width of the light along the line; surfaces below the target's face are
    ground times as bright. smoothing: columns of the driver's mean filter.
    mixed, lost, lost_at_edge, outliers: fractions of points at steps that lie between the levels,
    of lost points, of lost points within a few columns of a step, of gross outliers; reflections:
    fraction of the profiles with a false piece of line. delay: of the stamps, which are those of
    receipt. thinning: while the robot moves, only every nth profile is recorded.
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
    shear: float = 0.0
    line_bend: float = 0.0
    speckle: float = 0.0
    speckle_columns: float = 5.0
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
    A robot that stops at stations; reported pose = true pose + error.

    repeatability: (translation, rotation), 1 sigma of each axis, drawn once per station.
    systematic: (translation, rotation), RMS of the vectors of an error that varies smoothly over
    the workspace. geometry: 1 sigma of the errors of joints and links (m, and rad of 1 m) of a
    six-axis arm, 0: no arm. scale: relative error of reported positions.
    jitter: 1 sigma of each streamed pose (m and rad). dwell and move: duration of a stop and
    of a motion.
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

    Edge p is y = 0, edge q is x = 0; the face looks along +z. table: depth of the table below the
    face, None: no table. clutter: height above the face (negative: below) of the top of a block
    beside each of these edges, None: no blocks; clutter_gap, clutter_width: its distance from the
    edge, and its width. edge_angle: between p and q; rendered profiles, unlike direct samples, are
    always of a square plate. Only in rendered profiles: rounding: radius of the edges of the face;
    bevel: legs of their chamfer; bow: height of the middle of the face above its corners; waves:
    RMS of its waves.
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
    stem: float = 0.012
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
class Layout:
    """
    The frame and the message layout of the driver.

    frame: 'standard' (x along the line, z the range), or one of the others of
    stations.FRAMES. no_return: 'nan', 'inf', or 'omit' for points that are left out.
    """

    frame: str = 'standard'
    no_return: str = 'nan'


@dataclass(frozen=True)
class Sweep:
    """
    A path through all stops without stopping, a knot of a smooth curve at each; seconds.

    exposure: averaging time of one profile; rotation_lag: delay of the reported rotation.
    stamp_jitter, pose_jitter: 1 sigma of the stamps. gaps: number of gaps in the poses, each of
    duration gap. resolution: rounding of positions (m), 0: none. drift: RMS of the vectors of an
    error (translation, rotation) of the poses that varies smoothly over drift_time.
    """

    knot: float = 1.6
    exposure: float = 0.0
    rotation_lag: float = 0.0
    stamp_jitter: float = 0.0
    pose_jitter: float = 0.0
    gaps: int = 0
    gap: float = 0.3
    resolution: float = 0.0
    drift: tuple[float, float] = (0.0, 0.0)
    drift_time: float = 1.0


# Fields that a description leaves out: they do not change the profiles.
NOT_DESCRIBED = ('name', 'scene', 'sensor.rate', 'sensor.delay', 'sensor.thinning',
                 'robot.rate', 'robot.dwell', 'robot.move')


def _differences(first: Any, second: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    """Yield the dotted names of the fields that differ, and their values in the first."""
    for item in fields(first):
        a, b = getattr(first, item.name), getattr(second, item.name)
        if is_dataclass(a) and type(a) is type(b):
            yield from _differences(a, b, f'{prefix}{item.name}.')
        elif a != b:
            yield f'{prefix}{item.name}', re.sub(
                r'\d+\.\d{5,}', lambda number: f'{float(number[0]):.4g}', str(a))


@dataclass(frozen=True)
class Scenario:
    """
    All parameters of a recording.

    scene: key of scenes.SCENES. stations: number at each edge (plate), or in total (sphere: the
    sum). motion: key of stations.MOTIONS. tilt: largest tilt about each sensor axis. shuffled: the
    order of the stations is random. bumped: number of stations whose reported pose is grossly
    wrong. wrong_edges: number of stations at an edge of the plate that is neither p nor q. empty:
    there is no target. convention_errors: keys of CONVENTION_ERRORS, applied in order.
    repeats: number of runs of the programme of stops. lever: smallest and largest distance of the
    sensor from its mount. stated: wrong settings, by dotted key. sweep: the motion without stops;
    the repeatability is then drawn for each streamed pose.
    """

    name: str = 'plate'
    scene: str = 'plate'
    target: PlateTarget | SphereTarget | WedgeTarget = PlateTarget()
    sensor: SensorModel = field(default_factory=SensorModel)
    robot: RobotModel = field(default_factory=RobotModel)
    layout: Layout = field(default_factory=Layout)
    stations: tuple[int, int] = (9, 9)
    motion: str = 'general'
    tilt: float = math.radians(30)
    shuffled: bool = True
    calibration_type: str = 'eye_in_hand'
    bumped: int = 0
    wrong_edges: int = 0
    empty: bool = False
    convention_errors: tuple[str, ...] = ()
    repeats: int = 1
    lever: tuple[float, float] = (0.1, 0.2)
    stated: tuple[tuple[str, Any], ...] = ()
    sweep: Sweep | None = None

    @property
    def description(self) -> str:
        """Return the scene and the differences from a plain recording."""
        plain = Scenario(target=type(self.target)())
        values = [f'{key} {value}' for key, value in _differences(self, plain, '')
                  if key not in NOT_DESCRIBED]
        return ', '.join([self.scene, *values])

    @property
    def profiles_per_stop(self) -> int:
        """Return the number of profiles recorded during a stop."""
        return max(1, int(self.robot.dwell * self.sensor.rate))
