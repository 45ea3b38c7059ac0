"""
The line laser sensor of Zheng 2018, section 1.2: pixel to sensor plane, and back.

The camera looks along z_c, which meets the light plane at the sensor's origin O_l at the angle
theta. z_l lies in the light plane, in the plane of z_c and x_c, and points up; y_l lies in it
too, along y_c (the half turn of eq. 1 about x makes it -y_c); x_l is normal to it. L is the
distance from the lens' centre to the light plane, H that from O_l to its foot: tan theta = L / H.

Eqs. 1 to 5 are lost in the stored text; these follow from the text and figure 3. A point
(0, y, z) is (z sin theta, -y, D - z cos theta) in the camera, D = sqrt(L^2 + H^2), and is imaged
at (x_i, y_i, -f), so that

    z = D^2 x_i / (H x_i - f L),    y = L D y_i / (f L - H x_i).
"""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
import numpy as np


@dataclass(frozen=True)
class Sensor:
    """
    The sensor's parameters, metres.

    L: lens to light plane; H: from the foot of L to the origin; f: focal length (lens to image
    plane); pitch: of the pixels, along x_i and y_i; centre: the pixel on the optical axis.
    """

    L: float
    H: float
    f: float
    pitch: tuple[float, float] = (1.0, 1.0)
    centre: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def from_tilt(cls, theta: float, distance: float, f: float,
                  pitch: tuple[float, float] = (1.0, 1.0),
                  centre: tuple[float, float] = (0.0, 0.0)) -> Sensor:
        """Return a sensor from its tilt (radians) and the distance from lens to origin."""
        return cls(distance * np.sin(theta), distance * np.cos(theta), f, pitch, centre)

    @property
    def theta(self) -> float:
        """The angle (radians) between the optical axis and the light plane."""
        return float(np.arctan2(self.L, self.H))

    @property
    def T_camera_sensor(self) -> Array:
        """The (4, 4) transform of eqs. 1 and 2: shift O_l, half a turn about x, -theta about y."""
        shift = se3.transform(np.eye(3), np.array([self.L, 0.0, -self.H]))
        half_turn = np.diag([1.0, -1.0, -1.0])
        tilt = se3.exp_rotation(np.array([0.0, -self.theta, 0.0]))
        return np.asarray(se3.transform(tilt @ half_turn, np.zeros(3)) @ shift)


def to_plane(pixels: Array, sensor: Sensor) -> Array:
    """
    Return (n, 2) y and z in the sensor plane (metres) of (n, 2) pixels along x_i and y_i.

    A pixel on or beyond the image of the light plane's horizon gives NaN: nothing of the plane
    in front of the camera is seen there.
    """
    x, y = ((pixels - sensor.centre) * sensor.pitch).T
    D = np.hypot(sensor.L, sensor.H)
    scale = sensor.f * sensor.L - sensor.H * x
    scale = np.where(scale > 0.0, scale, np.nan)
    return np.column_stack([sensor.L * D * y / scale, -D ** 2 * x / scale])


def to_pixels(points: Array, sensor: Sensor) -> Array:
    """
    Return (n, 2) pixels of (n, 2) points y and z of the sensor plane (metres).

    A point behind the camera gives NaN.
    """
    y, z = points.T
    depth = np.hypot(sensor.L, sensor.H) - z * np.cos(sensor.theta)
    depth = np.where(depth > 0.0, depth, np.nan)
    image = sensor.f * np.column_stack([-z * np.sin(sensor.theta), y]) / depth[:, None]
    return np.asarray(image / sensor.pitch + sensor.centre)
