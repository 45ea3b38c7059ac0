"""
The profile filter of Zheng 2018, section 1.3: where the edge crosses the profile.

Median filter, slope from differences widened to +-4 neighbours, and the extremum of the second
derivative, likewise widened, as the feature point. The formulas are lost in the stored text,
which names the neighbours i +- 1 to i +- 4; used are the differences summed over them:

    slope_i = sum (z_{i+j} - z_{i-j}) / 20,    second_i = sum (z_{i+j} + z_{i-j} - 2 z_i) / 30.

Both are exact on parabolas. The paper picks among the extrema by how the plate lies to the
sensor. The plate is the nearer side, so its last point is where the range turns up most: the
maximum.
"""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.published.errors import TooFewError
import numpy as np
from scipy.ndimage import median_filter

NEIGHBOURS = 4
MINIMUM = 2 * NEIGHBOURS + 1


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
