"""
Points of a cloud as a profile: metres, one plane, ordered along the laser line.

Drivers differ. Deviations are corrected where possible; else the message is refused, and the error
names the setting to change.
"""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.node.errors import MessageError
from handeye_ros.sampling.profile_buffer import MOST_BACK
import numpy as np
from numpy.typing import NDArray

# No line profiler measures this far (m): a larger coordinate is no return. If most are larger, or
# with mm all are smaller than NEAR, the unit is wrong.
FAR = 10.0
NEAR = 1e-3

THICK = 2e-3  # m: largest distance of the points of a profile from its plane
THIN = 0.01  # of the spread across the plane: an axis with less is orthogonal to it
SURE = 10  # smallest number of returns for a decision on their order
# fraction of backward steps between returns: at most along the line, at least along the range
LINE_BACK, RANGE_BACK = 0.05, 0.1


def require_unit(points: Array, unit: str) -> None:
    """Raise MessageError for coordinates (n, k), in metres after unit, beyond any sensor."""
    reach = np.maximum(np.abs(points[:, 0]), np.abs(points[:, 1]))
    finite = np.isfinite(reach)
    too_far = finite & (reach > FAR)
    if too_far.sum() > finite.sum() / 2:
        raise MessageError('PointCloud2', f'coordinates reach {reach[too_far].max():.3g} m'
                           + (': set profile.unit to mm' if unit == 'm' else
                              ', but profile.unit is m or mm'))
    largest = reach[finite & ~too_far].max(initial=0.0)
    if unit == 'mm' and 0.0 < largest < NEAR:
        raise MessageError('PointCloud2', f'no coordinate is larger than {largest * 1e3:.3g} mm: '
                           'set profile.unit to m')


def returns(points: Array) -> NDArray[np.bool_]:
    """
    Return which of the points (n, k) are returns, (n,).

    Points that are not finite, too far, or in the origin are none; drivers publish the origin for
    missing returns.
    """
    x, z = points[:, 0], points[:, 1]  # numpy is slow along an axis of two
    with np.errstate(invalid='ignore'):
        in_range = (np.abs(x) <= FAR) & (np.abs(z) <= FAR)
    return np.asarray(in_range & ((x != 0) | (z != 0)))


def valid_columns(points: Array, good: NDArray[np.bool_]) -> Array:
    """Return the valid points (n, k) with each column contiguous in memory."""
    rows = np.flatnonzero(good)
    return points if len(rows) == len(points) else points.T.take(rows, axis=1).T


def has_unit(points: Array, valid_points: Array) -> bool:
    """Return whether points (n, k) with returns valid_points (m, k) are surely in the unit."""
    if not 2 * len(valid_points) > len(points):
        return False
    return bool(max(valid_points[:, :2].max(), -valid_points[:, :2].min()) > NEAR)


def median_of(values: Array) -> float:
    """Return the median of values (n,), 0 without any."""
    if not len(values):
        return 0.0
    if values[0] == values[-1] and (values == values[0]).all():
        return float(values[0])
    return float(np.nan_to_num(np.median(values)))


def require_one_plane(points: Array, axes: tuple[str, str, str]) -> None:
    """
    Raise MessageError for returns (n, 3) outside the plane of the first two axes.

    axes: the axes of the columns, without signs, as x z y.
    """
    if len(points) < 2:
        return
    if not points[:, 2].max() - points[:, 2].min() > THICK:  # nor where it is not finite
        return
    spread = [np.ptp(column) for column in points.T]
    text = (f'the points do not lie in the plane of {axes[0]} and {axes[1]}: '
            f'their {axes[2]} spans {spread[2] * 1e3:.1f} mm')
    if min(spread[:2]) < THIN * spread[2]:
        flat = int(np.argmin(spread[:2]))
        along, range_axis = sorted(((2, 1), (0, 2))[flat],
                                   key=lambda k: _back(np.diff(points[:, k])))
        text += (f', their {axes[flat]} nothing: set profile.axes to '
                 f'[{axes[along]}, {axes[range_axis]}]')
    else:
        text += ('; a line profiler measures in one plane: let its driver publish single '
                 'profiles in its own frame')
    raise MessageError('PointCloud2', text)


def ordered_points(points: Array, good: NDArray[np.bool_], valid_points: Array,
                   axes: tuple[str, ...]) -> Array:
    """
    Return the first two columns of points (n, k), ordered by the first.

    good: (n,) which are returns; valid_points: the returns; axes: of the columns, without signs.
    If the returns are in order, forwards or backwards, all points stay as they are: the rows
    without a return are then in place. Raises MessageError if the order shows wrong axes.
    """
    steps = valid_points[1:, 0] - valid_points[:-1, 0]
    monotonic = len(steps) and (steps.min() > 0 or steps.max() < 0)
    if not (monotonic or _one_way(steps, valid_points, axes)):
        return _sorted(points[:, :2])
    ordered = points[:, :2].copy(order='C')
    if len(valid_points) < len(points):
        ordered[~good] = np.nan
    return ordered


def _one_way(steps: Array, valid_points: Array, axes: tuple[str, ...]) -> bool:
    """Return whether steps between returns (n, 2) have one direction, except for a part."""
    if (len(steps) >= SURE and _back(steps) > RANGE_BACK
            and _back(np.diff(valid_points[:, 1])) < LINE_BACK):
        raise MessageError('PointCloud2', f'the points follow each other along {axes[1]}, not '
                           f'along {axes[0]}: set profile.axes to [{axes[1]}, {axes[0]}]')
    forth, back = steps[steps > 0].sum(), -steps[steps < 0].sum()
    return bool(min(forth, back) <= MOST_BACK * max(forth, back))


def _sorted(points: Array) -> Array:
    """Return points (n, 2) ordered by the first column; points with equal values are averaged."""
    with np.errstate(invalid='ignore'):
        in_range = points[np.abs(points[:, 0]) <= FAR]
    x, group = np.unique(in_range[:, 0], return_inverse=True)
    good = returns(in_range)
    count = np.bincount(group[good], minlength=len(x))
    total = np.bincount(group[good], in_range[good, 1], minlength=len(x))
    with np.errstate(invalid='ignore'):  # 0 / 0 where there is no return
        return np.column_stack([np.where(count > 0, x, np.nan), total / count])


def _back(steps: Array) -> float:
    """Return the share of steps against the direction of the majority."""
    return 1.0 - max(np.count_nonzero(steps > 0), np.count_nonzero(steps < 0)) / len(steps)
