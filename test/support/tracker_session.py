# Copyright 2026 The handeye_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a laser tracker and a profiler on an arm see of a ball and a block (Jing 2020)."""
from __future__ import annotations

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.published import jing2020
from handeye_ros.simulate.tables import BALL_RADIUS, frame_3, H0, H1, SWEEP_ANGLE
import numpy as np
from scipy.spatial.transform import Rotation

Q30 = 0.00298
T_flange_sensor = se3.transform(Rotation.from_euler('xyz', [89.2, 0.9, -1.3], True).as_matrix(),
                                np.array([0.057, -0.11, 0.049]))


def block(rng: np.random.Generator, skew: float) -> tuple[Array, tuple[Array, Array], Array]:
    """Return a point on the ridge, the faces' normals and the ball's centre, sensor at q30."""
    tilt = Rotation.from_euler('xyz', rng.uniform(-12, 12, 3), degrees=True).as_matrix()
    slopes = np.deg2rad([-40.0, 50.0 + skew])
    normals = np.column_stack([np.sin(slopes), np.zeros(2), -np.cos(slopes)]) @ tilt.T
    return (np.array([0.004, 0.02, 0.172]), (normals[0], normals[1]),
            np.array([-0.003, -0.025, 0.178]))


def face_profiles(normal: Array, ridge: Array, x: Array, steps: Array, along: Array) -> Array:
    """Return x, z and q3 (n, 3) of a face seen by a sensor moved by steps along a direction."""
    across, step = (g.ravel() for g in np.meshgrid(x, steps))
    z = (normal @ ridge - across * normal[0] - step * (along @ normal)) / normal[2]
    return np.column_stack([across, z, step + Q30])


def ball_profiles(ball: Array, steps: Array, along: Array) -> Array:
    """Return x, z and q3 (n, 3) of the near side of the ball, sensor moved as above."""
    rows = []
    for step in steps:
        centre = ball - step * along
        room = BALL_RADIUS ** 2 - centre[1] ** 2
        for angle in np.deg2rad(np.linspace(-60, 60, 21)) if room > 0 else ():
            rows.append([centre[0] + np.sqrt(room) * np.sin(angle),
                         centre[2] - np.sqrt(room) * np.cos(angle), step + Q30])
    return np.array(rows)


def session(seed: int, tracker_noise: float = 0.0, sensor_noise: float = 0.0,
            skew: float = 0.0) -> jing2020.Readings:
    """Return what tracker and profiler see of arm, ball and block (1 sigma in metres)."""
    rng = np.random.default_rng(seed)
    T_tracker_arm = se3.transform(Rotation.from_euler('xyz', [3, -4, 50], True).as_matrix(),
                                  np.array([3.0, 1.7, -0.6]))
    reflector = np.array([[0.02, H0 + H1, 0.25]])
    arc = np.array([se3.apply(frame_3(turn, 0.0), reflector)[0]
                    for turn in np.deg2rad(np.linspace(-60, 60, 40))])
    line = np.array([se3.apply(frame_3(SWEEP_ANGLE, q), reflector)[0]
                     for q in np.linspace(-0.1, 0.1, 30)])
    ridge, normals, ball = block(rng, skew)
    along = T_flange_sensor[2, :3]
    x = np.linspace(0.002, 0.018, 10)
    steps = np.linspace(-0.06, 0.06, 41)
    faces = [face_profiles(n, ridge, ridge[0] + s * x, steps[20:], along)
             for n, s in zip(normals, (-1, 1), strict=True)]
    T_tracker_sensor = T_tracker_arm @ frame_3(SWEEP_ANGLE, Q30) @ T_flange_sensor
    spots = [se3.apply(T_tracker_sensor, jing2020.swept(f[::6], Q30, along)) for f in faces]
    truth = [se3.apply(T_tracker_arm, arc), se3.apply(T_tracker_arm, line),
             se3.apply(T_tracker_sensor, ball[None]), *spots]
    noisy = [p + tracker_noise * rng.normal(size=p.shape) for p in truth]
    swept = [p + sensor_noise * rng.normal(size=p.shape) * [1, 1, 0]
             for p in (ball_profiles(ball, steps, along), *faces)]
    names = ('arc', 'line', 'ball', 'face_c', 'face_d',
             'swept_ball', 'swept_face_c', 'swept_face_d')
    return jing2020.Readings(dict(zip(names, [*noisy, *swept], strict=True)), H0 + H1, Q30)
