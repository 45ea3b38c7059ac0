"""
The points of a cloud as a profile: in metres, in one plane, in the order of the laser line.

Drivers send what they like; what can be put right is, and what cannot is refused with the
setting that would.
"""
from __future__ import annotations

from handeye_ros.data import Array
from handeye_ros.ros.errors import MessageError
from handeye_ros.sampling.profile_buffer import MOST_BACK
import numpy as np
from numpy.typing import NDArray

# No line profiler measures so far (m): a coordinate beyond is no return, and when most
# are, or with mm all lie nearer than NEAR, the unit is wrong.
FAR = 10.0
NEAR = 1e-3

THICK = 2e-3  # m; points of one profile do not leave its plane by so much
THIN = 0.01  # of the spread across the plane: an axis with less is the one across it
SURE = 10  # so many returns do not follow each other by chance
# of the steps between returns: fewer go back along the line, more along the range
LINE_BACK, RANGE_BACK = 0.05, 0.1


def require_unit(points: Array, unit: str) -> None:
    """Refuse coordinates (n, k), in metres after unit, that no sensor gives (MessageError)."""
    reach = np.maximum(np.abs(points[:, 0]), np.abs(points[:, 1]))
    finite = np.isfinite(reach)
    far = finite & (reach > FAR)
    if far.sum() > finite.sum() / 2:
        raise MessageError('PointCloud2', f'coordinates reach {reach[far].max():.3g} m'
                           + (': set profile.unit to mm' if unit == 'm' else
                              ', but profile.unit is m or mm'))
    largest = reach[finite & ~far].max(initial=0.0)
    if unit == 'mm' and 0.0 < largest < NEAR:
        raise MessageError('PointCloud2', f'no coordinate is larger than {largest * 1e3:.3g} mm: '
                           'set profile.unit to m')


def returns(points: Array) -> NDArray[np.bool_]:
    """
    Tell which of the points (n, k) are returns, (n,).

    None is one that is not finite, is too far, or lies in the origin itself, which drivers
    give for want of a better number.
    """
    x, z = points[:, 0], points[:, 1]  # numpy is slow along an axis of two
    with np.errstate(invalid='ignore'):
        near = (np.abs(x) <= FAR) & (np.abs(z) <= FAR)
    return np.asarray(near & ((x != 0) | (z != 0)))


def chosen(points: Array, good: NDArray[np.bool_]) -> Array:
    """Return the good ones of points (n, k), whose columns lie one behind the other."""
    rows = np.flatnonzero(good)
    return points if len(rows) == len(points) else points.T.take(rows, axis=1).T


def surely_of_unit(points: Array, seen: Array) -> bool:
    """Return whether points (n, k), of which seen (m, k) are returns, leave no doubt of it."""
    if not 2 * len(seen) > len(points):
        return False
    return bool(max(seen[:, :2].max(), -seen[:, :2].min()) > NEAR)


def middle(values: Array) -> float:
    """Return the median of values (n,), 0 where there is none."""
    if not len(values):
        return 0.0
    if values[0] == values[-1] and (values == values[0]).all():
        return float(values[0])
    return float(np.nan_to_num(np.median(values)))


def require_one_plane(points: Array, axes: tuple[str, str, str]) -> None:
    """
    Refuse returns (n, 3) that do not lie in the plane of the first two axes (MessageError).

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
        empty = int(np.argmin(spread[:2]))
        left, right = sorted(((2, 1), (0, 2))[empty], key=lambda k: _back(np.diff(points[:, k])))
        text += (f', their {axes[empty]} nothing: set profile.axes to '
                 f'[{axes[left]}, {axes[right]}]')
    else:
        text += ('; a line profiler measures in one plane: let its driver publish single '
                 'profiles in its own frame')
    raise MessageError('PointCloud2', text)


def along_the_line(points: Array, good: NDArray[np.bool_], seen: Array, axes: tuple[str, ...]
                   ) -> Array:
    """
    Return the first two columns of points (n, k) in the order of the first.

    A profile is a function of it. good: (n,) which are returns; seen: those. Where they are in
    order, forwards or backwards, all stay as they are: the rows without a return are then where
    they belong. Raises MessageError where the order shows that the axes are wrong. axes: those
    of the columns, without signs.
    """
    steps = seen[1:, 0] - seen[:-1, 0]
    if not (_all_one_way(steps) or _one_way(steps, seen, axes)):
        return _sorted(points[:, :2])
    kept = points[:, :2].copy(order='C')
    if len(seen) < len(points):
        kept[~good] = np.nan
    return kept


def _all_one_way(steps: Array) -> bool:
    return bool(len(steps) and (steps.min() > 0 or steps.max() < 0))


def _one_way(steps: Array, seen: Array, axes: tuple[str, ...]) -> bool:
    """Return whether steps between returns (n, 2) lead one way, but for a part of it."""
    if (len(steps) >= SURE and _back(steps) > RANGE_BACK
            and _back(np.diff(seen[:, 1])) < LINE_BACK):
        raise MessageError('PointCloud2', f'the points follow each other along {axes[1]}, not '
                           f'along {axes[0]}: set profile.axes to [{axes[1]}, {axes[0]}]')
    forth, back = steps[steps > 0].sum(), -steps[steps < 0].sum()
    return bool(min(forth, back) <= MOST_BACK * max(forth, back))


def _sorted(points: Array) -> Array:
    """Return points (n, 2) in the order of the first column, means where it is the same."""
    with np.errstate(invalid='ignore'):
        placed = points[np.abs(points[:, 0]) <= FAR]
    x, group = np.unique(placed[:, 0], return_inverse=True)
    good = returns(placed)
    count = np.bincount(group[good], minlength=len(x))
    total = np.bincount(group[good], placed[good, 1], minlength=len(x))
    with np.errstate(invalid='ignore'):  # 0 / 0 where there is no return
        return np.column_stack([np.where(count > 0, x, np.nan), total / count])


def _back(steps: Array) -> float:
    """Return the share of steps that do not go the way of the most."""
    return 1.0 - max(np.count_nonzero(steps > 0), np.count_nonzero(steps < 0)) / len(steps)
