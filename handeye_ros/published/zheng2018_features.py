"""
The profile filter of Zheng 2018, section 1.3: where the edge crosses the profile; and its sensor.

Median filter, slope from differences widened to +-4 neighbours, and the extremum of the second
derivative, likewise widened, as the feature point. The formulas are lost in the stored text,
which names the neighbours i +- 1 to i +- 4; used are the differences summed over them:

    slope_i = sum (z_{i+j} - z_{i-j}) / 20,    second_i = sum (z_{i+j} + z_{i-j} - 2 z_i) / 30.

Both are exact on parabolas. The paper picks among the extrema by how the plate lies to the
sensor. The plate is the nearer side, so its last point is where the range turns up most: the
maximum.
"""
from __future__ import annotations

from dataclasses import dataclass

from handeye_ros import se3
from handeye_ros.data import Array
from handeye_ros.errors import TooFewError
import numpy as np
from scipy.ndimage import median_filter

NEIGHBOURS = 4
MINIMUM = 2 * NEIGHBOURS + 1


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


def derivatives(z: Array) -> tuple[Array, Array]:
    """Return slope and second derivative (n,) of a range (n,) by sample; NaN in the border."""
    slope, second = np.full((2, len(z)), np.nan)
    middle = slice(NEIGHBOURS, len(z) - NEIGHBOURS)
    slope[middle] = second[middle] = 0.0
    for j in range(1, NEIGHBOURS + 1):
        ahead = z[NEIGHBOURS + j:len(z) - NEIGHBOURS + j]
        behind = z[NEIGHBOURS - j:len(z) - NEIGHBOURS - j]
        slope[middle] += (ahead - behind) / 20.0
        second[middle] += (ahead + behind - 2.0 * z[middle]) / 30.0
    return slope, second


def edge_point(points: Array, width: int = 5, range_sign: int = 1) -> Array:
    """
    Return the feature point (2,) of a profile (n, 2): the plate's last point at the step.

    points: along the line and range (metres), rows with NaN are left out; width: of the
    median filter (samples); range_sign: -1 when the range grows towards the sensor.
    Raises TooFewError. A profile without a step has an extremum too: the paper takes it.
    """
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < MINIMUM:
        raise TooFewError('the profile filter of Zheng 2018', MINIMUM, 'points', len(points))
    z = median_filter(points[:, 1], size=width, mode='nearest')
    _, second = derivatives(range_sign * z)
    i = int(np.nanargmax(second))
    return np.array([points[i, 0], z[i]])
