"""What acts on all points of a profile together: a wide spot of light, speckle, filters."""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.simulate.scenario import SensorModel
import numpy as np
from scipy.ndimage import convolve1d, gaussian_filter1d

GROUND = -2e-4  # height over the target's face (m) below which another surface is seen
WIDEST = 2.5  # sigmas of a spot
FAINT = 0.15  # share of a spot on one surface, times its brightness, that no camera sees


def blurred(sensor: SensorModel, z: Array, T: Array) -> Array:
    """
    Return ranges (m, n) as a spot of some width shows them.

    T: (m, 4, 4) T_target_sensor. The camera takes the brighter of two surfaces under one spot,
    and of that the middle of what is lit.
    """
    if not sensor.spot:
        return z
    across = np.linspace(-1, 1, z.shape[1]) * sensor.half_width
    height = T[:, 2, :1] * across * z + T[:, 2, 2:3] * z + T[:, 2, 3:]
    pitch = 2 * sensor.half_width * np.mean(sensor.range) / sensor.columns
    reach = int(np.ceil(WIDEST * sensor.spot / pitch))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * pitch / sensor.spot)**2)
    kernel /= kernel.sum()
    seen = np.isfinite(z)
    best, result = np.full(z.shape, FAINT), np.full(z.shape, np.nan)
    for on, bright in ((seen & (height > GROUND), 1.0), (seen & ~(height > GROUND),
                                                         sensor.ground)):
        share = convolve1d(on.astype(float), kernel, mode='constant')
        total = convolve1d(np.where(on, z, 0.0), kernel, mode='constant')
        wins = bright * share > best
        result[wins] = total[wins] / share[wins]
        best = np.where(wins, bright * share, best)
    return result


def speckle(sensor: SensorModel, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Return an error (m, n) that is correlated along each row."""
    white = rng.normal(size=shape)
    smooth = gaussian_filter1d(white, sensor.speckle_columns, axis=1, mode='wrap')
    return np.asarray(sensor.speckle * smooth / smooth.std())


def smoothed(sensor: SensorModel, z: Array) -> Array:
    """Return ranges (m, n) after the mean filter of the driver; what was lost stays lost."""
    if sensor.smoothing < 2:
        return z
    seen = np.isfinite(z)
    kernel = np.ones(sensor.smoothing)
    total = convolve1d(np.where(seen, z, 0.0), kernel, axis=1, mode='constant')
    count = convolve1d(seen.astype(float), kernel, axis=1, mode='constant')
    return np.where(seen, total / np.maximum(count, 1), np.nan)
